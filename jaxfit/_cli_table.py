"""The table of `jaxfit batch`: a row for each file, as JSON lines and as CSV; it also says what is done."""

import csv
import io as text_io
import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jaxfit.io._output import write_atomically

Row = dict[str, Any]

COLUMNS = (
    "input status error points left_out method net order iterations average_error_percent "
    "maximum_error_percent folds message surface seconds size_and_time options"
).split()
FITTED, MISSED, FAILED = "fitted", "tolerance missed", "failed"
_RESTS = 20  # times as long as the last writing took, before the table is written again


class Table:
    """The rows of a folder, by input. Both files are always whole: they are replaced in one step."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.lines, self.sheet = folder / "table.jsonl", folder / "table.csv"
        self.rows: dict[str, Row] = {}
        self._unwritten, self._next = False, 0.0
        if self.lines.exists():
            self.rows = {row["input"]: row for row in _read(self.lines)}

    def is_done(self, wanted: Row, again: bool) -> bool:
        """Whether the row of this input stands, from the same file and with the same options."""
        row = self.rows.get(wanted["input"])
        if row is None or any(row.get(key) != wanted[key] for key in ("size_and_time", "options")):
            return False
        if row["status"] == FAILED:
            return not again
        surface = self.folder / row["surface"]
        return row["surface"] == wanted["surface"] and surface.is_file() and surface.stat().st_size > 0

    def owners(self) -> dict[str, str]:
        """The inputs that there still are, by the surface that was made of each."""
        rows = self.rows.items()
        return {row["surface"]: name for name, row in rows if row["surface"] and Path(name).exists()}

    def put(self, row: Row) -> None:
        """Take a row in; it is written now, or after a rest that keeps writing cheap. Who had its surface
        before, an input that is gone, has no row any more.
        """
        mine = row["surface"]
        self.rows = {name: x for name, x in self.rows.items() if mine is None or x["surface"] != mine}
        self.rows[row["input"]] = {name: row.get(name) for name in COLUMNS}
        self._unwritten = True
        self.write_if_rested()

    def write_if_rested(self) -> None:
        """Write what is not yet written, unless that was done just before."""
        if self._unwritten and time.monotonic() >= self._next:
            self.write()

    def write(self) -> None:
        """Write both files."""
        begun = time.monotonic()
        rows = list(self.rows.values())
        write_atomically(self.lines, "".join(json.dumps(row) + "\n" for row in rows).encode())
        write_atomically(self.sheet, _as_csv(rows).encode())
        self._unwritten, now = False, time.monotonic()
        self._next = now + _RESTS * (now - begun)

    def sort(self, inputs: Iterable[str]) -> None:
        """Rows of other files first, as they are, then these inputs in their order."""
        given = {name: self.rows.pop(name) for name in inputs if name in self.rows}
        self.rows |= given


def _read(path: Path) -> list[Row]:
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        if all(isinstance(row, dict) and {"input", "status", "surface"} <= set(row) for row in rows):
            return rows
    except (ValueError, OSError):
        pass
    raise OSError(f"{path} holds no table that can be read; remove it to fit all files again.")


def _as_csv(rows: list[Row]) -> str:
    text = text_io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
