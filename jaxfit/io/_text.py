"""Columns of numbers in text files, with the line number of whatever is no number."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfit.io._point_data import InputError

FIRST = 0, 1, 2
_DELIMITERS = {",": "commas", ";": "semicolons", None: "blanks"}


def read_columns(path: Path) -> Float[np.ndarray, "points 3"]:
    """The columns x, y and z of a text file, or the first three: between semicolons if its first line has
    some, else commas in .csv, blanks otherwise.

    Raises
    ------
    InputError
        With the line number, for anything that is not a finite number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} holds no plain text; save it as text in UTF-8.") from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if (stripped := line.strip()) and not stripped.startswith("#")
    ]
    delimiter = "," if path.suffix.lower() == ".csv" else None
    if lines and ";" in lines[0][1].split("#")[0]:
        delimiter = ";"
    names = lines.pop(0)[1].split(delimiter) if lines and _is_header(lines[0][1]) else []
    if not lines:
        raise InputError(f"{path} holds no points; write one point a line.")
    _check_commas(path, [line for _, line in lines], delimiter, len(names))
    columns = _columns(names)
    try:
        values = np.loadtxt([line for _, line in lines], delimiter=delimiter, usecols=columns)
    except ValueError as error:
        raise InputError(_explain(path, lines, delimiter, columns)) from error
    values = values.reshape(-1, 3)
    good = np.isfinite(values).all(axis=1)
    if not good.all():
        raise InputError(
            f"{path}: {int((~good).sum())} of {len(values)} points have NaN or infinite "
            f"coordinates, the first in line {lines[int(np.argmin(good))][0]}; remove or repair "
            "them."
        )
    if columns == FIRST:
        _check_first_column(path, values[:, 0], len(lines[0][1].split("#")[0].split(delimiter)))
    return values


def _columns(names: list[str]) -> tuple[int, int, int]:
    """Those named x, y and z, if each is there once, else the first three."""
    named = [name.strip().strip("\"'").lower() for name in names]
    if any(named.count(name) != 1 for name in "xyz"):
        return FIRST
    return named.index("x"), named.index("y"), named.index("z")


def _check_commas(path: Path, lines: list[str], delimiter: str | None, named: int) -> None:
    """Raise where commas may be those of decimals.

    They are, between blanks or semicolons. They may be in six columns of nothing but digits, or in as many
    as change from line to line, unless the first line names as many columns.
    """
    remedy = "write decimals with points, as 1.5"
    cells = re.split(r"[;\s]+", lines[0].split("#")[0].strip())
    found = len(cells) > 1 and any(re.fullmatch(r"[+-]?\d*,\d+", cell) for cell in cells)
    if not found and delimiter == ",":
        columns = {len(line.split(delimiter)) for line in lines}
        suspicious = columns != {named} and (columns == {6} or (len(columns) > 1 and min(columns) >= 3))
        found = suspicious and not any(re.search(r"[^-+\d,\s]", line) for line in lines)
        remedy += ", or if these are whole numbers, give every line as many and name them in the first"
    if found:
        raise InputError(f"{path} seems to hold decimal commas ({lines[0].strip()}); {remedy}.")


def _check_first_column(path: Path, first: np.ndarray, columns: int) -> None:
    """Raise if the first of four or more columns only counts the points, from 0 or 1."""
    if columns >= 4 and len(first) >= 4 and first[0] in (0, 1) and (np.diff(first) == 1).all():
        raise InputError(
            f"{path}: the first column only counts the points, from {first[0]:.0f} to {first[-1]:.0f}; "
            "remove it, so that x, y and z come first."
        )


def _is_header(line: str) -> bool:
    return not any(_is_number(cell) for cell in re.split(r"[,;\s]+", line))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _explain(
    path: Path, lines: list[tuple[int, str]], delimiter: str | None, columns: tuple[int, int, int]
) -> str:
    """The sentence for the first line that cannot be read (NumPy counts other lines)."""
    for number, line in lines:
        cells = line.split("#")[0].split(delimiter)
        if len(cells) <= max(columns):
            hint, least = _DELIMITERS[delimiter], max(columns) + 1
            return (
                f"{path}: line {number} has {len(cells)} column{'s' * (len(cells) != 1)}, but a "
                f"point has {'three' if least == 3 else least}; separate x, y and z by {hint}."
            )
        for cell in (cells[column] for column in columns):
            if not _is_number(cell):
                return f"{path}: line {number} has {cell.strip()!r} in place of a number; mend it."
    return f"{path} is not a table of numbers; write one point a line."
