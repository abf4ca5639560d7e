"""`python -m benchmarks` uses public names only, says what it runs, and writes what it measured."""

import ast
import json
import subprocess
import sys

import numpy as np
import pytest
from helpers import CHECKOUT, wavy_cloud, wavy_surface

import jaxfit as jf

sys.path.insert(0, str(CHECKOUT))

from benchmarks import __main__ as program
from benchmarks import _inputs, _referee, _report, _timing

FOLDER = CHECKOUT / "benchmarks"
FILES = sorted(FOLDER.glob("*.py"))


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
    for path in FILES:
        names = set(names_of_jaxfit(ast.parse(path.read_text())))
        assert not [name for name in names if private(name)], path
        missing = [name for name in names if name and not hasattr(jf, name.split(".")[0])]
        assert not missing, f"{path}: these are no public names of jaxfit"


def test_every_file_is_a_suite_a_study_or_a_part_of_one():
    names = {path.stem for path in FILES if not path.stem.startswith("_")}
    parts = {"paper_grids", "paper_clouds"}
    assert names == set(program.SUITES) | set(program.STUDIES) | parts


def test_suites_and_studies_explain_themselves():
    # One process imports JAX once for all of them.
    script = """
import importlib, sys
from benchmarks.__main__ import main
suites, *names = sys.argv[1:]  # a study gets a sys.argv of its own
for name in names:
    try:
        main([name, "--help"])
    except SystemExit as end:
        assert end.code == 0, name
    else:
        raise AssertionError(name + " has no --help")
for name in suites.split():
    module = importlib.import_module("benchmarks." + name)
    assert module.__doc__ and all(part.__doc__ for part in module.PARTS.values()), name
"""
    command = [sys.executable, "-c", script, " ".join(program.SUITES), "paper", *program.STUDIES]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(program.STUDIES) + 1


def test_an_unknown_suite_or_part_is_a_sentence(capsys):
    with pytest.raises(SystemExit):
        program.main(["papers"])
    assert "'papers' is no suite" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="--only table9: there is no such part"):
        program.main(["paper", "--only", "table9"])


def test_the_referee_finds_true_distances_and_folds():
    surface = wavy_surface()
    points = wavy_cloud(300)[0]
    away = _referee.distances(surface.control_points, (surface.knots_u, surface.knots_v), points)
    np.testing.assert_allclose(away, jf.closest_point(surface, points).distance, atol=1e-8)
    assert _referee.folds(surface.control_points, (surface.knots_u, surface.knots_v)) == 0
    net = np.array(surface.control_points)
    net[2, :, 0] = 0.9  # a row that goes ahead and back
    assert _referee.folds(net, (surface.knots_u, surface.knots_v)) > 0


def test_stand_ins_are_finite_and_have_the_sizes_of_the_paper():
    assert [x.points.shape for x in _inputs.grids(True)] == [(10, 10, 3), (50, 200, 3), (100, 400, 3)]
    clouds = list(_inputs.clouds(True))
    assert [len(x.points) for x in clouds] == [3_000, 11_469, 138_632]
    assert all(np.isfinite(x.points).all() for x in clouds)


def test_a_report_is_written_with_the_machine(tmp_path):
    report = _report.Report(quiet=True)
    report.table("A title", "A note.")
    found = _timing.timed(lambda: 1, 3)
    report.row(method="one", **found.cells())
    report.row(method="two", share=float("nan"))
    report.write(tmp_path / "r.json", tmp_path / "r.md")
    read = json.loads((tmp_path / "r.json").read_text())
    assert read["machine"]["cores"] >= 1
    assert read["tables"][0]["rows"][0]["lowest s"] <= read["tables"][0]["rows"][0]["median s"]
    page = (tmp_path / "r.md").read_text()
    assert "## A title" in page
    assert "| two |" in page
