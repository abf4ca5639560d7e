"""`report`: a fit on one page of HTML, with its pictures inside."""

import base64
import html
import io
import os
import platform
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import scipy

from jaxfit._fit._summary import facts
from jaxfit._version import __version__
from jaxfit.io._output import check_output, write_atomically
from jaxfit.plot._history import history
from jaxfit.plot._loops import loops
from jaxfit.plot._part import check_fit, of_fit
from jaxfit.plot._picture import surface_beside_errors
from jaxfit.plot._zebra import zebra_stripes

_DPI = 110
_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 64rem;
  margin: 0 auto; padding: 1rem; }}
h1 {{ font-size: 1.5rem; overflow-wrap: anywhere; }}
h2 {{ font-size: 1.15rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid #ddd; }}
table {{ border-collapse: collapse; width: 100%; }}
th, td {{ text-align: left; vertical-align: top; padding: 0.2rem 0.8rem 0.2rem 0; overflow-wrap: anywhere; }}
th {{ font-weight: 600; width: 30%; min-width: 6.5rem; overflow-wrap: normal; }}
figure {{ margin: 1rem 0; flex: 1 1 22rem; }}
.row {{ display: flex; flex-wrap: wrap; column-gap: 1rem; }}
img {{ display: block; max-width: 100%; height: auto; margin: 0 auto; }}
figcaption {{ color: #555; font-size: 0.9rem; }}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def report(
    fit: Any,
    path: str | os.PathLike,
    points: Any = None,
    title: str = "B-spline surface",
    tables: Mapping[str, Mapping[str, str]] | None = None,
) -> None:
    """Write one page of HTML about a fit: result, pictures and versions, without requests to anywhere.

    Pictures are those of `surface_and_errors` (with folds), one beside the other where the window is wide
    enough, `zebra_stripes` of a surface in space, `loops` and `history`, inside the page. The page can be
    read on a telephone.

    Parameters
    ----------
    fit
        A `jaxfit.Fit`.
    path
        The file, `.html` or `.htm`. It appears whole or not at all, and replaces an older one.
    points
        The data, as for `surface_and_errors`.
    title
        Heading, for instance the name of the data.
    tables
        More tables, by their headings; they come first.

    Raises
    ------
    ImportError
        If Matplotlib is not installed.
    ValueError, OSError
        If the file cannot be written.
    TypeError
        If `fit` is no fit.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> x, y = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 5), indexing="ij")
    >>> fit = jf.interpolate(np.stack([x, y, x * y], axis=2), jf.StandardInterpolation())
    >>> page = pathlib.Path(tempfile.mkdtemp()) / "saddle.html"
    >>> jf.plot.report(fit, page, title="A saddle")
    >>> "A saddle" in page.read_text()
    True
    """
    check_fit(fit)
    check_output(path, (".html", ".htm"))
    rows = {
        **(tables or {}),
        "Result": {"method": str(fit.stats["method"]), **facts(fit)},
    }
    parts = [_table(heading, values) for heading, values in rows.items()]
    parts += [_figures(*pictures) for pictures in _pictures(fit, points)]
    parts.append(_table("Versions", _versions()))
    page = _PAGE.format(title=html.escape(title), body="\n".join(parts))
    write_atomically(path, page.encode())


def _pictures(fit: Any, points: Any) -> list[tuple[str, list[tuple[Any, str]]]]:
    """Headings, each with figures and their captions."""
    surface, errors = surface_beside_errors(fit, points)
    trimmed = getattr(fit, "trimmed", None)
    both = [(surface, "The surface. Folds are red."), (errors, "Distances of the points. Folds are crosses.")]
    pictures = [("Errors and folds", both)]
    if fit.surface.dimension == 3:
        stripes = "Lights reflected in the surface: where they kink or wiggle, so does it."
        pictures.append(("Zebra stripes", [(zebra_stripes(of_fit(fit)), stripes)]))
    if trimmed is not None or np.ndim(fit.errors) == 1:
        where = "Feet of the points in the domain, and its knots"
        caption = f"{where}, with the outer loop (full) and holes (dashed)." if trimmed else f"{where}."
        pictures.append(("Loops" if trimmed else "Parameters", [(loops(fit), caption)]))
    if int(fit.stats["num_steps"]):
        pictures.append(("History", [(history(fit), "Errors after every iteration.")]))
    return pictures


def _table(heading: str, rows: Mapping[str, str]) -> str:
    cells = (
        f"<tr><th>{html.escape(str(name))}</th><td>{html.escape(str(value))}</td></tr>"
        for name, value in rows.items()
    )
    return f"<h2>{html.escape(heading)}</h2>\n<table>\n{chr(10).join(cells)}\n</table>"


def _figures(heading: str, figures: list[tuple[Any, str]]) -> str:
    """Figures under one heading, beside one another where there is room."""
    name = html.escape(heading)
    parts = "\n".join(_figure(name, *figure) for figure in figures)
    return f'<h2>{name}</h2>\n<div class="row">\n{parts}\n</div>'


def _figure(name: str, figure: Any, caption: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    data = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img alt="{name}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _versions() -> dict[str, str]:
    device = jax.devices()[0]
    return {
        "jaxfit": __version__,
        "Python": platform.python_version(),
        "JAX": f"{jax.__version__} on {device.platform} ({device.device_kind})",
        "NumPy": np.__version__,
        "SciPy": scipy.__version__,
        "system": f"{platform.system()} {platform.machine()}",
    }
