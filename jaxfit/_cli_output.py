"""What the command line shows: its table, plain text where rich is missing, and its sentences."""

import importlib.util
import re
import sys
from collections.abc import Mapping

# Options that sentences of the library name as in Python; not as a part of a file's name.
_IN_PYTHON = re.compile(r"(?<![\w./\\-])(hole_length|tol_average|tol_maximum|max_steps)(?![\w-]|[./\\]\w)")
REWORDED = {  # what else they say in Python
    " (fit.regularity.fold_parameters)": "",
    "StandardInterpolation()": "--method interpolate-standard",
    "border=FreeBorder()": "--border free",
    "a method with loss=Tukey()": "--loss tukey",
    "by fit_points, as a cloud": "by --method approximate",
    "work in float64 (the flag jax_enable_x64 of jax.config)": "leave out --float32",
    "switch on double precision, the flag jax_enable_x64 of jax.config": "leave out --float32",
    "switch on jax_enable_x64": "leave out --float32",
    "loosen them, or pass a net.": "loosen them, or give a net by --net.",
}


def as_sentence(error: object) -> str:
    """What the library says in one line, its options by the names they have on the command line."""
    line = " ".join(str(error).split())
    for python, reworded in REWORDED.items():
        line = line.replace(python, reworded)
    return _IN_PYTHON.sub(lambda found: "--" + found[1].replace("_", "-"), line)


def print_table(rows: Mapping[str, str]) -> None:
    """Print names and values in two columns on stdout: whole lines where no terminal has a width."""
    if importlib.util.find_spec("rich") is None or not sys.stdout.isatty():
        width = max(map(len, rows))
        for name, value in rows.items():
            print(f"{name:<{width}}  {value}")
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(name, Text(value))  # no markup: file names may hold brackets
    Console().print(table)
