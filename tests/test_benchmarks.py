"""The programs in `benchmarks/` use public names only, and each says what it takes."""

import ast
import subprocess
import sys

from helpers import CHECKOUT

import jaxfit

FOLDER = CHECKOUT / "benchmarks"
PROGRAMS = sorted(FOLDER.glob("*.py"))


def private(name):
    """Whether a part of a dotted name is private."""
    return any(part.startswith("_") and not part.startswith("__") for part in name.split("."))


def names_of_jaxfit(tree):
    """All dotted names that a program takes from jaxfit, without "jaxfit." in front."""
    aliases = {"jaxfit"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "jaxfit":
                    aliases.add(alias.asname or "jaxfit")
                    yield alias.name.removeprefix("jaxfit").lstrip(".")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jaxfit":
            for alias in node.names:
                yield f"{node.module}.{alias.name}".removeprefix("jaxfit.")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases:
            yield node.attr


def test_benchmarks_take_public_names_only():
    for path in PROGRAMS:
        names = set(names_of_jaxfit(ast.parse(path.read_text())))
        assert names, path
        assert not [name for name in names if private(name)], path
        missing = [name for name in names if name and not hasattr(jaxfit, name.split(".")[0])]
        assert not missing, f"{path}: these are no public names of jaxfit"


def test_benchmarks_are_programs_with_a_docstring_and_a_main():
    for path in PROGRAMS:
        tree = ast.parse(path.read_text())
        assert f"python benchmarks/{path.name}" in ast.get_docstring(tree)
        assert "main" in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)], path
        guard = tree.body[-1]
        assert isinstance(guard, ast.If), path
        assert ast.unparse(guard.test) == "__name__ == '__main__'"


def test_every_benchmark_explains_its_options():
    # One process imports JAX once for all of them.
    program = """
import runpy, sys
sys.path.insert(0, sys.argv[1])
for path in sys.argv[2:]:
    sys.argv = [path, "--help"]
    try:
        runpy.run_path(path, run_name="__main__")
    except SystemExit as end:
        assert end.code == 0, path
    else:
        raise AssertionError(path + " has no --help")
"""
    command = [sys.executable, "-c", program, str(FOLDER), *map(str, PROGRAMS)]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(PROGRAMS)
