"""Columns of numbers in text files, with the line number of whatever is no number."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfit.io._point_data import MOST_COLUMNS, InputError

FIRST = 0, 1, 2
_PACKED = b"\x1f\x8b", b"PK"  # how files of gzip and zip begin
_UTF_16 = b"\xff\xfe", b"\xfe\xff"
_SAID = 8  # names of columns in a sentence
_DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs", None: "blanks"}
_UNIT = r"(?:[_\s](?:[munkcdµμ]?m|in|ft)|\s*[/(\[#].*)?"  # of a name: x_mm, x mm, X [mm], X (mm), x/mm


def read_columns(path: Path) -> Float[np.ndarray, "points 3"]:
    """The columns x, y and z of a text file, or the first three: between semicolons if its first point has
    some, else commas or tabs in .csv, blanks otherwise, or whichever of them there are.

    Raises
    ------
    InputError
        With the line number, for anything that is not a finite number.
    """
    lines = [
        (number, line)
        for number, line in enumerate(_text(path).splitlines(), start=1)
        if (stripped := line.strip()) and not stripped.startswith("#")
    ]
    if len(lines) > 1 and lines[0][1].strip() == str(len(lines) - 1):  # how many points follow
        lines.pop(0)
    header = lines.pop(0)[1] if lines and _is_header(lines[0][1]) else ""
    if not lines:
        raise InputError(f"{path} holds no points; write one point a line.")
    first = lines[0][1].split("#")[0]
    delimiter = _delimiter(path, first)
    names, found = _names(header, delimiter), len(first.split(delimiter))
    _check_commas(path, [line for _, line in lines], delimiter, len(names))
    named = _named_columns(path, names, found, title=delimiter is None and len(names) > found)
    columns = named or FIRST
    try:
        texts = [line for _, line in lines]
        values = np.loadtxt(texts, delimiter=delimiter, usecols=columns, quotechar='"')
    except ValueError as error:
        raise InputError(_explain(path, lines, delimiter, columns)) from error
    if delimiter is not None:
        _check_columns(path, lines, delimiter)
    values = values.reshape(-1, 3)
    good = np.isfinite(values).all(axis=1)
    if not good.all():
        raise InputError(
            f"{path}: {int((~good).sum())} of {len(values)} points have NaN or infinite "
            f"coordinates, the first in line {lines[int(np.argmin(good))][0]}; remove or repair "
            "them."
        )
    if named is None:
        _check_first_column(path, values, found)
    return values


def _text(path: Path) -> str:
    """The file in UTF-8, or what its first bytes say; comments may be in Latin-1."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    try:
        return raw.decode("utf-16" if raw[:2] in _UTF_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        packed = raw[:2] in _PACKED
        if packed or b"\0" in raw:
            remedy = "is packed; unpack it" if packed else "holds no plain text; save it as text in UTF-8"
            raise InputError(f"{path} {remedy}.") from error
        return raw.decode("latin-1")


def _delimiter(path: Path, first: str) -> str | None:
    """What separates the columns of the first point, None for blanks."""
    if ";" in first:
        return ";"
    if re.fullmatch(r"\s*[^\s,]+(,\s+[^\s,]+)+,?\s*", first):  # before a blank it is no decimal comma
        return ","
    blanks = len(first.split()) > 1
    if path.suffix.lower() != ".csv":
        return "," if first.count(",") > 1 and not blanks else None
    if "," in first or not blanks:
        return ","
    return "\t" if "\t" in first else None


def _named_columns(path: Path, names: list[str], found: int, title: bool) -> tuple[int, int, int] | None:
    """The columns that are named x, y and z; None for the first three, where the names say nothing else.

    There are more words in a `title` than columns were `found`, so that nobody knows which belong to one.
    """
    named = _axes(names)
    if named is not None and (named == FIRST or not title):
        return named
    mixed = named is not None and np.diff(named).tolist() != [1, 1]
    if mixed or (len(names) > 3 and found > 3):
        said = ", ".join(name.strip(" \"'") or "''" for name in names[:_SAID])
        said += ", ..." * (len(names) > _SAID)
        but = "" if len(names) == found else f", but has {found}"
        raise InputError(f"{path} names its columns {said}{but}; name three of them x, y and z.")
    if found > MOST_COLUMNS:
        raise InputError(
            f"{path} has {found} columns without names; give one point x,y,z a line, or name the columns, or "
            "write the heights as a grid (n, m, 3) in .npy."
        )
    return None


def _names(header: str, delimiter: str | None) -> list[str]:
    """The names of columns, of which none is an empty one at the end."""
    between = delimiter if delimiter and delimiter in header else None
    between = between or next((x for x in "\t;," if x in header), delimiter)
    if between is None:  # a unit in brackets is no column of its own
        header = re.sub(r"\s*[(\[].*?[)\]]", "", header)
    return header.rstrip(f"{between or ''} \t").split(between)


def _axes(names: list[str]) -> tuple[int, int, int] | None:
    """Which columns are named x, y and z, each once: without a unit, or else with one."""
    for unit in ("", _UNIT):
        pattern = rf"""["'/\s]*([xyz]){unit}["'\s]*"""
        found = [re.fullmatch(pattern, name, re.IGNORECASE) for name in names]
        axes = [match[1].lower() if match else "" for match in found]
        if all(axes.count(axis) == 1 for axis in "xyz"):
            return axes.index("x"), axes.index("y"), axes.index("z")
    return None


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


def _check_columns(path: Path, lines: list[tuple[int, str]], delimiter: str) -> None:
    """Raise if a line has more columns than the first point: in which of them would x be?"""
    most = lines[0][1].split("#")[0].count(delimiter)
    for number, line in lines:
        if line.count(delimiter) <= most or '"' in line:  # quotes may hold anything
            continue
        count = line.split("#")[0].count(delimiter)
        if count > most:
            raise InputError(
                f"{path}: line {number} has {count + 1} columns, but the first point has {most + 1}; give "
                "all points as many."
            )


def _check_first_column(path: Path, values: np.ndarray, columns: int) -> None:
    """Raise if the first of four or more columns only counts the points, from 0 or 1, or numbers them: if it
    holds whole numbers, each once, and the next two do not.
    """
    first, whole = values[:, 0], values == np.floor(values)
    if columns < 4 or len(first) < 4 or not whole[:, 0].all():
        return
    counts = first[0] in (0, 1) and (np.diff(first) == 1).all()
    numbers = not whole[:, 1:].all(axis=0).any() and len(np.unique(first)) == len(first)
    if counts or numbers:
        does = "counts" if counts else "numbers"
        raise InputError(
            f"{path}: the first column only {does} the points, from {first.min():.0f} to {first.max():.0f}; "
            "remove it, or name the columns x, y and z in the first line."
        )


def _is_header(line: str) -> bool:
    return not any(_is_number(cell) for cell in re.split(r"[,;\s]+", line))


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().strip('"'))
    except ValueError:
        return False
    return True


def _explain(
    path: Path, lines: list[tuple[int, str]], delimiter: str | None, columns: tuple[int, int, int]
) -> str:
    """The sentence for the first line that cannot be read (NumPy counts other lines)."""
    for number, line in lines:
        cells = line.split("#")[0].split(delimiter)
        short = len(cells) <= max(columns)
        wrong = [] if short else [x for x in (cells[k] for k in columns) if not _is_number(x)]
        if not (short or wrong):
            continue
        if line is lines[0][1] and any(_is_header(x) for _, x in lines[:2]):
            return (
                f"{path}: line {number} is no point, and only one line of names may come first; put # before "
                "the others."
            )
        if short:
            hint, least = _DELIMITERS[delimiter], max(columns) + 1
            return (
                f"{path}: line {number} has {len(cells)} column{'s' * (len(cells) != 1)}, but a "
                f"point has {'three' if least == 3 else least}; separate x, y and z by {hint}."
            )
        return f"{path}: line {number} has {wrong[0].strip()!r} in place of a number; mend it."
    return f"{path} is not a table of numbers; write one point a line."
