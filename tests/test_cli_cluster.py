"""`jaxfit batch --scheduler`: the table of a Dask cluster, one of whose workers is killed half-way."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from helpers import CHECKOUT, wavy_cloud

pytest.importorskip("distributed", reason="needs the extra [cluster]")

BROKEN = ["garbage.npz", "none.npz", "nan.npz"]
CLOUDS = [f"cloud{i}.npz" for i in range(8)]
SECONDS = 400  # a machine that others use, too
OF_A_RUN = ("seconds", "surface", "message", "error")  # columns that may differ between two runs


@pytest.fixture
def folder(tmp_path):
    """Clouds of one size, and three files that no fit can be made of."""
    for i, name in enumerate([*CLOUDS, "nan.npz"]):
        points, edges = wavy_cloud(3000, seed=i)
        points = np.nan * points if name == "nan.npz" else points
        np.savez(tmp_path / name, points=points, **{f"boundary_{side}": x for side, x in edges.items()})
    (tmp_path / "garbage.npz").write_text("no points")
    return tmp_path


@pytest.fixture
def cluster(folder):
    """The address of a scheduler, and its two workers."""
    place = folder / "scheduler.json"

    def dask(*argv):
        command = [sys.executable, "-m", "dask", *argv, "--scheduler-file", str(place)]
        with open(folder / f"{argv[0]}.log", "a") as log:
            return subprocess.Popen(command, cwd=folder, env=environment(folder), stdout=log, stderr=log)

    scheduler = dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    until(place.exists, "the scheduler")
    options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder))
    workers = [dask("worker", *options) for _ in range(2)]
    yield json.loads(place.read_text())["address"], workers
    for process in (*workers, scheduler):
        process.kill()
        process.wait()


def environment(folder):
    shared = {"PYTHONPATH": str(CHECKOUT), "JAXFIT_CACHE_DIR": str(folder / "programs")}
    return {**os.environ, **shared, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "10"}


def until(holds, what):
    end = time.monotonic() + SECONDS
    while not holds():
        assert time.monotonic() < end, f"{what} did not come"
        time.sleep(0.05)


def batch(folder, output, *options):
    """The command, running."""
    files = [BROKEN[0], *CLOUDS, *BROKEN[1:]]
    fit = "--net 8x7 --max-steps 40 --tol-average 1e-9 --method geometric --quiet".split()
    command = [sys.executable, "-m", "jaxfit", "batch", *files, "-o", output, *fit, *options]
    return subprocess.Popen(command, cwd=folder, env=environment(folder), stderr=subprocess.PIPE, text=True)


def table(folder, output):
    """The rows by file, without what differs from run to run."""
    with open(folder / output / "table.jsonl") as lines:
        rows = [json.loads(line) for line in lines]
    return {os.path.basename(x["input"]): {k: x[k] for k in x if k not in OF_A_RUN} for x in rows}


@pytest.mark.slow
def test_the_table_is_the_same_where_a_worker_is_killed_half_way(folder, cluster):
    address, workers = cluster
    running = batch(folder, "out", "--scheduler", address)
    out = folder / "out"
    until(lambda: running.poll() is not None or len(list(out.glob("cloud*.npz"))) > 1, "a fit")
    assert running.poll() is None, running.stderr.read()
    workers[0].send_signal(signal.SIGKILL)
    said = running.communicate(timeout=SECONDS)[1]
    assert running.returncode == 3, said
    assert workers[1].poll() is None
    assert sum(name in line for line in said.splitlines() for name in BROKEN) == len(BROKEN)
    found = table(folder, "out")
    assert list(found) == [BROKEN[0], *CLOUDS, *BROKEN[1:]]
    assert [name for name in found if found[name]["status"] == "failed"] == BROKEN

    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    again = batch(folder, "out", "--scheduler", address)
    lines = again.communicate(timeout=SECONDS)[1].splitlines()
    assert again.returncode == 3
    assert len(lines) == len(BROKEN)
    assert all(line.endswith("(In an earlier run.)") for line in lines)
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == before

    here = batch(folder, "here")
    here.communicate(timeout=SECONDS)
    assert here.returncode == 3
    assert table(folder, "here") == found
