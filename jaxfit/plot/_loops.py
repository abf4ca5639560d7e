"""`loops`: the region of a trimmed fit in the domain of its surface."""

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfit._trimmed._area import knot_lines
from jaxfit.plot._part import check_fit
from jaxfit.plot._picture import blank_figure, draw_loops, finished

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_POINTS = 20_000  # drawn of each kind; of more every so many


def loops(fit: Any, path: str | os.PathLike | None = None, title: str = "", dpi: int = 150) -> "Figure":
    """One picture of the parameters (u, v): the loops, the knots, and the points inside and outside.

    Points that the fit left out are red, too, wherever their feet are.

    Parameters
    ----------
    fit
        A `jaxfit.Fit`; without loops all points are inside.
    path
        Where to save the picture (.png, .pdf, .svg, ...), whole or not at all; None saves nothing.
    title
        Heading, for instance the name of the data.
    dpi
        Pixels per inch; the picture is 7 x 5.2 inches.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ImportError
        If Matplotlib is not installed.
    TypeError
        If `fit` is no fit.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 5), indexing="ij")
    >>> fit = jf.interpolate(np.stack([x, y, x * y], axis=2), jf.StandardInterpolation())
    >>> jf.plot.loops(fit).get_size_inches().tolist()
    [7.0, 5.2]
    """
    check_fit(fit)
    figure = blank_figure(7)
    axes = figure.subplots()
    for lines, draw in zip(knot_lines(fit.surface), (axes.axvline, axes.axhline), strict=True):
        for at in lines:
            draw(at, color="0.88", linewidth=0.5, zorder=0)
    u, v = (np.asarray(x, float).reshape(-1) for x in (fit.u, fit.v))
    trimmed = getattr(fit, "trimmed", None)
    inside = np.ones(u.size, bool) if trimmed is None else np.asarray(fit.inside).reshape(-1)
    kinds = ((inside, "0.45", 2.0, "inside"), (~inside, "tab:red", 12.0, "outside or left out"))
    for mask, colour, size, label in kinds:
        if mask.any():
            style: dict[str, Any] = {
                "s": size,
                "linewidths": 0,
                "color": colour,
                "label": f"{int(mask.sum()):,} points {label}",
            }
            every = -(-int(mask.sum()) // _MOST_POINTS)
            axes.scatter(u[mask][::every], v[mask][::every], **style)
    draw_loops(axes, trimmed)
    axes.set_xlabel("u")
    axes.set_ylabel("v")
    handles: Any = axes.legend(loc="upper right", fontsize=8, framealpha=0.9).legend_handles
    for handle in handles:
        handle.set_sizes([32.0])
    return finished(figure, path, title, dpi)
