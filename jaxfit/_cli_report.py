"""The page that `--report` writes: what was read, what was asked, and the fit."""

import argparse
from collections.abc import Mapping
from typing import Any

from jaxfit import io
from jaxfit._cli_arguments import argument_parser
from jaxfit._cli_fit import FittedFile
from jaxfit._cli_methods import OPTIONS

_SETTINGS = "method net order grid hole_length tol_average tol_maximum max_steps float32".split()


def write_page(
    args: argparse.Namespace,
    data: io.PointData,
    done: FittedFile,
    read: Mapping[str, str],
    written: Mapping[str, str],
) -> None:
    """Write ``args.report``; `read` and `written` are rows of the command's table."""
    from jaxfit.plot import report

    report(
        done.fit,
        args.report,
        points=data.cloud if data.grid is None else data.grid,
        title=data.name,
        tables={"Input": read, "Settings": _settings(args, done), "Output": written},
    )


def _settings(args: argparse.Namespace, done: FittedFile) -> dict[str, str]:
    """The tolerances, and the options that were given, by the names they have on the command line."""
    defaults = argument_parser().parse_args(["fit", "", "-o", ""])
    names = [name for name in (*_SETTINGS, *OPTIONS) if getattr(args, name) != getattr(defaults, name)]
    said = {name: _said(name, getattr(args, name)) for name in names}
    options = {f"--{name.replace('_', '-')}": value for name, value in said.items()}
    return {"tolerances": done.tolerances, **options}


def _said(name: str, value: Any) -> str:
    if isinstance(value, tuple):
        return "{}x{}".format(*value)
    if name.startswith("tol_"):
        return f"{value:g} %"
    return "yes" if value is True else str(value)
