"""`jaxfit batch`: one table of many files, whatever is wrong with some, whoever fits them."""

import csv
import dataclasses
import json
import os
import sys
from concurrent.futures import BrokenExecutor, Future

import numpy as np
import pytest
from helpers import wavy_cloud, wavy_grid

import jaxfit as jf
from jaxfit import _cli, _cli_workers
from jaxfit._cli_fit import FitOfFile
from jaxfit._cli_table import COLUMNS
from jaxfit._cli_workers import Processes, Schedule
from jaxfit.io import read_surface

GOOD = ["a.npz", "b.npz", "grid.npz"]
BAD = ["garbage.npz", "none.npz", "nan.npz"]
OPTIONS = "--net 8x8 --max-steps 3 --quiet".split()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for i, name in enumerate("ab"):
        points, edges = wavy_cloud(400, seed=i)
        sides = {f"boundary_{side}": polyline for side, polyline in edges.items()}
        np.savez(tmp_path / f"{name}.npz", points=points, **sides)
    np.savez(tmp_path / "nan.npz", points=np.nan * points, **sides)
    np.savez(tmp_path / "grid.npz", grid=wavy_grid(20, 20))  # as many: one program
    (tmp_path / "garbage.npz").write_text("no points")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")
    return tmp_path


def batch(*argv):
    return _cli.main(["batch", *argv, "-o", "out", *OPTIONS])


def rows():
    with open("out/table.jsonl") as lines:
        found = [json.loads(line) for line in lines]
    with open("out/table.csv", newline="") as file:
        sheet = list(csv.DictReader(file))
    assert [row["input"] for row in sheet] == [row["input"] for row in found]
    assert all(tuple(row) == tuple(COLUMNS) for row in [*found, *sheet])
    return {os.path.basename(row["input"]): row for row in found}


def state():
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in os.scandir("out")}


def test_bad_files_are_reported_and_passed_over(folder, capsys):
    assert batch(BAD[0], *GOOD, *BAD[1:]) == 3
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 3
    assert all(name in line for name, line in zip(BAD, said, strict=True))
    table = rows()
    assert list(table) == [BAD[0], *GOOD, *BAD[1:]]
    assert "is damaged" in table["garbage.npz"]["error"]
    assert "does not exist" in table["none.npz"]["error"]
    assert "NaN" in table["nan.npz"]["error"]
    assert sorted(os.listdir("out")) == [*GOOD, "table.csv", "table.jsonl"]
    for name in GOOD:
        assert read_surface(f"out/{name}").shape == (8, 8)
        assert (table[name]["net"], table[name]["status"]) == ("8x8", "fitted")
        assert table[name]["method"] == "OrthogonalDistance"
        assert 0 < table[name]["average_error_percent"] < 1

    before = state()  # a second run does nothing
    assert batch(BAD[0], *GOOD, *BAD[1:]) == 3
    assert state() == before
    assert capsys.readouterr().err.splitlines() == [f"{line} (In an earlier run.)" for line in said]
    assert _cli.main(["batch", *GOOD, *BAD, "-o", "out", *(x for x in OPTIONS if x != "--quiet")]) == 3
    shown = capsys.readouterr().out
    assert "3 failed; see out/table.csv; --retry-failed fits the failed ones again" in shown


def test_folds_are_those_inside_the_loops(folder, monkeypatch):
    grid = wavy_grid(8, 7)
    grid[6] = grid[4] - [0.05, 0, 0]  # folded near the last row
    np.savez("grid.npz", grid=grid)
    real = FitOfFile.run

    def with_loops(self):
        done = real(self)
        assert done.fit.folds > 0
        corners = np.array([[0, 0], [0.3, 0], [0.3, 1], [0, 1]])
        trimmed = jf.TrimmedSurface(done.fit.surface, (corners,))
        return done._replace(fit=dataclasses.replace(done.fit, trimmed=trimmed))

    monkeypatch.setattr(FitOfFile, "run", with_loops)
    assert _cli.main(["batch", "grid.npz", "-o", "out", "--quiet"]) == 0
    assert rows()["grid.npz"]["folds"] == 0


def test_what_has_changed_is_fitted_again(folder, monkeypatch):
    fitted = []
    real = _cli_workers.Here.submit
    monkeypatch.setattr(
        _cli_workers.Here,
        "submit",
        lambda self, function, job: (
            fitted.append(os.path.basename(job.arguments["input"])) or real(self, function, job)
        ),
    )

    def run(*argv):
        fitted.clear()
        return batch(*argv), list(fitted)

    assert run("a.npz", "grid.npz") == (0, ["a.npz", "grid.npz"])
    assert run("a.npz", "grid.npz", "nan.npz") == (3, ["nan.npz"])
    assert run("nan.npz", "--retry-failed") == (3, ["nan.npz"])
    os.utime("a.npz", ns=(0, 0))
    assert run("a.npz", "grid.npz") == (0, ["a.npz"])
    os.unlink("out/grid.npz")
    assert run("a.npz", "grid.npz") == (0, ["grid.npz"])
    os.truncate("out/grid.npz", 0)
    assert run("a.npz", "grid.npz") == (0, ["grid.npz"])
    assert run("grid.npz", "--tol-maximum", "1e-9") == (1, ["grid.npz"])
    (folder / "a.npz").write_text("no points any more")
    assert run("a.npz") == (3, ["a.npz"])
    assert not os.path.exists("out/a.npz")
    assert list(rows()) == ["nan.npz", "grid.npz", "a.npz"]


def test_a_surface_of_an_earlier_run_is_not_written_over_while_its_input_is_there(folder, capsys):
    (folder / "other").mkdir()
    (folder / "other" / "a.npz").write_bytes((folder / "b.npz").read_bytes())
    assert batch("a.npz") == 0
    before = state()
    capsys.readouterr()
    assert batch("other/a.npz") == 2
    assert "would both write a.npz in out; rename one" in capsys.readouterr().err
    assert state() == before
    os.unlink("a.npz")
    assert batch("other/a.npz") == 0
    assert [row["input"] for row in rows().values()] == [str(folder / "other" / "a.npz")]


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["a.npz", "other/a.npz"], "would both write a.npz"),
        (["a.npz", "-o", "."], "holds the file a.npz"),
        (["a.npz", "-o", "other"], "holds the file a.npz"),  # a link to it
        (["grid.npz", "--normals", "other/grid.npz", "-o", "other"], "holds the file grid.npz"),
        (["grid.npz", "--boundary", "other/grid.npz", "-o", "other"], "holds the file grid.npz"),
        (["a.npz", "-o", "a.npz"], "cannot be made"),
        (["a.npz", "other", "-o", "out"], "other is a folder; name the files in it, as in other/*."),
        (["a.npz", "none/*.npz", "-o", "out"], "none/*.npz matches no file"),
        (["a.npz", "--net", "3x9"], "net must be at least 4 x 4"),
        (["a.npz", "--workers", "0"], "'0' is no number of processes"),
        (["a.npz", "--workers", "2", "--scheduler", "x"], "not allowed with"),
        (["a.npz", "--scheduler", "tcp://x"], 'pip install "jaxfit-surfaces[cluster]"'),
        ([], "FILE"),
    ],
)
def test_bad_usage_is_one_sentence(folder, capsys, monkeypatch, argv, said):
    monkeypatch.setitem(sys.modules, "distributed", None)
    os.mkdir("other")
    os.symlink(folder / "a.npz", "other/a.npz")
    os.link("b.npz", "other/grid.npz")
    output = [] if "-o" in argv else ["-o", "out"]
    assert _cli.main(["batch", *argv, *output]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("jaxfit: error: ")
    assert captured.err.count("\n") == 1
    assert said in captured.err


def test_a_table_that_cannot_be_read_is_left_alone(folder, capsys):
    os.mkdir("out")
    (folder / "out" / "table.jsonl").write_text("none")
    assert batch("a.npz") == 2
    assert "holds no table" in capsys.readouterr().err
    assert (folder / "out" / "table.jsonl").read_text() == "none"


# ------------------------------------------------------------------ who fits when


class Pool:
    """Takes `width` jobs at once, finishes them in turn; jobs named "fatal" end it, and "last" once done."""

    def __init__(self, width):
        self.width, self.open, self.starts, self.ended, self.is_broken = width, [], [], 0, False

    def submit(self, function, job):
        if self.is_broken:
            raise BrokenExecutor
        future = Future()
        self.open.append((job, future))
        self.starts.append((job, [other for other, _ in self.open[:-1]]))
        return future

    def finish(self):
        if self.is_broken or any(job.startswith("fatal") for job, _ in self.open):
            self.is_broken = True
            for _, future in self.open:
                future.set_exception(BrokenExecutor())
            self.open.clear()
        elif self.open:
            job, future = self.open.pop(0)
            future.set_result(job)
            self.is_broken = job.startswith("last")

    def restart(self):
        self.ended, self.is_broken = self.ended + 1, False


def run(pool, jobs, monkeypatch):
    real = _cli_workers.wait
    monkeypatch.setattr(
        _cli_workers, "wait", lambda *args, **options: pool.finish() or real(*args, **options)
    )
    schedule = Schedule(pool, jobs, lambda job: job[-1] if job[-1].isdigit() else None)
    return list(schedule.run(str, lambda job: f"{job} died", lambda: None))


def test_the_first_file_of_a_size_compiles_for_the_others(monkeypatch):
    pool = Pool(3)
    jobs = ["a1", "b1", "c1", "d2", "e2", "f"]
    assert sorted(run(pool, jobs, monkeypatch)) == sorted(jobs)
    beside = dict(pool.starts)
    assert beside["d2"] == ["a1"]  # another size does not wait
    assert "a1" not in beside["b1"] + beside["c1"]
    assert "d2" not in beside["e2"]
    assert [job for job, _ in pool.starts][:3] == ["a1", "d2", "f"]


def test_a_file_that_ends_its_process_is_found_and_passed_over(monkeypatch):
    pool = Pool(3)
    found = run(pool, ["a", "fatal", "b", "c", "fatal too", "d"], monkeypatch)
    assert sorted(found) == ["a", "b", "c", "d", "fatal died", "fatal too died"]
    assert 2 <= pool.ended <= 4


@pytest.mark.parametrize("width", [1, 3])
def test_a_process_that_ends_between_two_files_costs_none(monkeypatch, width):
    pool = Pool(width)
    jobs = ["a", "last", "b", "c", "last too", "d", "e"]
    assert sorted(run(pool, jobs, monkeypatch)) == sorted(jobs)
    assert pool.ended == 2


def maybe_end(job):
    if job == "fatal":
        os._exit(1)
    return os.environ["NPROC"], job


@pytest.mark.slow
def test_processes_that_end_are_replaced():
    pool = Processes(2)
    found = list(
        Schedule(pool, ["a", "fatal", "b"], lambda job: None).run(maybe_end, lambda job: "died", lambda: None)
    )
    pool.shutdown()
    share = str(max(1, len(os.sched_getaffinity(0)) // 2))
    assert sorted(found, key=str) == [(share, "a"), (share, "b"), "died"]
