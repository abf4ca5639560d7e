"""Run the first block of Python in the README and all notebooks, or those that are named; fails where one does.

    python notebooks/execute.py [--write] [NAME.ipynb ...]

With --write the outputs are kept in the files.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent


def execute_readme():
    """Run the first block of Python in the README, as a reader would paste it."""
    block = (HERE.parent / "README.md").read_text().split("```python\n")[1].split("```")[0]
    subprocess.run([sys.executable, "-c", block], cwd=HERE.parent, check=True)


def execute(path, write):
    """Run one notebook in a kernel of its own, and say how long that took."""
    book = nbformat.read(path, as_version=4)
    begun = time.perf_counter()
    where = {"metadata": {"path": str(HERE)}}
    NotebookClient(book, timeout=600, resources=where, coalesce_streams=True).execute()  # a table: one output
    print(f"{path.name}: {time.perf_counter() - begun:.0f} s", flush=True)
    if write:
        for cell in book.cells:
            cell.metadata.pop("execution", None)  # times, which differ from run to run
        nbformat.write(book, path)


def main():
    """Run them one after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path)
    parser.add_argument("--write", action="store_true", help="keep the outputs")
    options = parser.parse_args()
    os.environ["JAXFIT_PROGRESS"] = "off"  # no line in the stored outputs
    if not options.notebooks:
        execute_readme()
    for path in options.notebooks or sorted(HERE.glob("*.ipynb")):
        execute(path, options.write)


if __name__ == "__main__":
    main()
