"""Tables as they are measured: printed row by row, then written as JSON and Markdown with the machine."""

import datetime
import importlib.metadata
import json
import os
import platform
from pathlib import Path

import jax
import numpy as np

PACKAGES = "jaxfit-surfaces jax jaxlib numpy scipy geomdl splinepy splipy pygismo cvxopt".split()
PACKAGES += ["scikit-sparse", "cadquery-ocp-novtk"]


def version(package):
    """Its version, or None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor():
    """The name of the processor."""
    info = Path("/proc/cpuinfo")
    names = [line for line in info.read_text().splitlines() if "model name" in line] if info.is_file() else []
    return names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()


def machine():
    """What the figures depend on, other work on the machine included."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = {key: os.environ[key] for key in ("NPROC", "OMP_NUM_THREADS", "XLA_FLAGS") if key in os.environ}
    return {
        "date": datetime.date.today().isoformat(),
        "processor": processor(),
        "cores": cores,
        "threads": threads or "as many as cores",
        "load before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "backend": jax.default_backend(),
        "python": platform.python_version(),
        "precision": "float64",
        "compile cache": jax.config.jax_compilation_cache_dir or "none",
        **{package: version(package) or "not installed" for package in PACKAGES},
    }


def text(value):
    """A cell: numbers with four digits."""
    if isinstance(value, (float, np.floating)):
        return "-" if np.isnan(value) else f"{value:.4g}"
    return "" if value is None else str(value)


class Report:
    """Tables, each with a title, a note and rows of cells by name."""

    def __init__(self, quiet=False):
        self.machine = machine()
        self.tables = []
        self.quiet = quiet
        self.say("; ".join(f"{key} {text(value)}" for key, value in self.machine.items()))

    def say(self, line):
        if not self.quiet:
            print(line, flush=True)

    def table(self, title, note=""):
        """Begin a table."""
        self.tables.append({"title": title, "note": note, "rows": [], "remarks": []})
        self.say(f"\n{title}\n{note}".rstrip())

    def row(self, **cells):
        """Append a row to the last table; the names of the cells are the heads."""
        rows = self.tables[-1]["rows"]
        cells = {key.replace("_", " "): value for key, value in cells.items()}
        if not rows or list(rows[-1]) != list(cells):
            self.say("  ".join(f"{key:>{width(k)}}" for k, key in enumerate(cells)))
        rows.append(cells)
        self.say("  ".join(f"{text(x):>{width(k)}}" for k, x in enumerate(cells.values())))

    def remark(self, sentence):
        """A sentence below the last table."""
        self.tables[-1]["remarks"].append(sentence)
        self.say(f"  {sentence}")

    def markdown(self):
        """All tables."""
        lines = [f"{key} {text(value)}" for key, value in self.machine.items()]
        parts = ["; ".join(lines) + "."]
        for table in self.tables:
            parts.append("\n".join(filter(None, [f"## {table['title']}", "", table["note"]])))
            if table["rows"]:
                heads = list(dict.fromkeys(key for row in table["rows"] for key in row))
                body = [[text(row.get(key)) for key in heads] for row in table["rows"]]
                parts.append(
                    "\n".join("| " + " | ".join(x) + " |" for x in [heads, ["---"] * len(heads), *body])
                )
            parts += table["remarks"]
        return "\n\n".join(parts) + "\n"

    def write(self, as_json=None, as_markdown=None):
        """Write the files that are named."""
        if as_json:
            document = {"machine": self.machine, "tables": self.tables}
            Path(as_json).write_text(json.dumps(document, indent=1, default=float) + "\n")
        if as_markdown:
            Path(as_markdown).write_text(self.markdown())


def width(column):
    """Characters of a column on the screen."""
    return 26 if column < 2 else 11
