"""The command line end to end: real files, real fits, real exit codes."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from helpers import CHECKOUT, diagonal, wavy_cloud, wavy_grid

from jaxfit import _cli
from jaxfit.io import read_surface


@pytest.fixture
def folder(tmp_path, monkeypatch):
    points, edges = wavy_cloud(400)
    sides = {f"boundary_{side}": polyline for side, polyline in edges.items()}
    np.savez(tmp_path / "cloud.npz", points=points, **sides)
    np.savez(tmp_path / "grid.npz", grid=wavy_grid(8, 7))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXFIT_CACHE_DIR", "off")
    return tmp_path


# As in the session itself, code that compiles quickly.
SURROUNDINGS = {
    "PYTHONPATH": str(CHECKOUT),
    "JAX_PLATFORMS": "cpu",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
}


def command(*argv, **environment):
    """Run `python -m jaxfit`, as a user would, with no test session around it."""
    return subprocess.run(
        [sys.executable, "-m", "jaxfit", *argv],
        env=os.environ | SURROUNDINGS | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def shown(output, name):
    return float(re.search(rf"{name}\s+(\S+) %", output)[1])


def test_a_grid_is_interpolated(folder, capsys):
    assert _cli.main(["fit", "grid.npz", "-o", "s.npz", "--no-picture"]) == 0
    surface, grid = read_surface("s.npz"), wavy_grid(8, 7)
    assert surface.shape == (8, 7)
    us, vs = np.linspace(0, 1, 400), np.linspace(0, 1, 400)
    near = np.asarray(surface.grid(us, vs)).reshape(-1, 1, 3) - grid[3, 4].reshape(1, 1, 3)
    assert np.linalg.norm(near, axis=-1).min() < 5e-3 * diagonal(grid)
    assert shown(capsys.readouterr().out, "maximum error") < 1e-3


def test_a_cloud_is_approximated(folder, capsys):
    argv = "fit cloud.npz -o s.json --net 8x8 --tol-average 0.05 --max-steps 200".split()
    assert _cli.main(argv) == 0
    assert shown(capsys.readouterr().out, "average error") <= 0.05
    assert read_surface("s.json").shape == (8, 8)
    assert (folder / "s.png").stat().st_size > 10_000


def test_another_method_fits_a_cloud(folder, capsys):
    argv = "fit cloud.npz --method geometric --loss huber --insertion --border corners -o s.npz".split()
    assert _cli.main([*argv, *"--net 6x6 --max-steps 4 --tol-average 1 --no-picture".split()]) == 0
    assert shown(capsys.readouterr().out, "average error") <= 1


@pytest.mark.parametrize("argv", ["--method interpolate-standard", "--symmetry rows"])
def test_every_method_interpolates_a_grid(folder, capsys, argv):
    grid = wavy_grid(8, 7)
    np.savez("even.npz", grid=0.5 * (grid + grid[::-1] * [-1, 1, 1] + [1, 0, 0]))
    assert _cli.main(["fit", "even.npz", *argv.split(), "-o", "s.npz", "--no-picture"]) == 0
    assert shown(capsys.readouterr().out, "maximum error") < 1e-3


def test_a_tolerance_out_of_reach_is_told(folder):
    argv = "fit cloud.npz -o s.npz --net 8x8 --tol-maximum 1e-9 --max-steps 5 --no-picture".split()
    assert _cli.main([*argv, "--quiet"]) == 1
    assert (folder / "s.npz").is_file()


def test_a_net_smaller_than_the_order_is_refused(folder, capsys):
    argv = "fit cloud.npz -o s.npz --net 3x8 --no-picture".split()
    assert _cli.main(argv) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxfit: error: ")
    assert error.count("\n") == 1
    assert not (folder / "s.npz").exists()


@pytest.mark.slow
def test_the_command_stands_alone_in_single_precision(folder):
    done = command("fit", "cloud.npz", "-o", "s.npz", "--net", "6x6", "--float32", "--no-picture")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "single precision" in done.stdout
    with np.load("s.npz") as file:
        assert file["control_points"].dtype == np.float32


def test_the_command_switches_to_double_precision(folder):
    done = command("fit", "grid.npz", "-o", "s.npz", "--quiet", "--no-picture", JAX_ENABLE_X64="0")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    with np.load("s.npz") as file:
        assert file["control_points"].dtype == np.float64


def test_errors_leave_no_traceback(folder):
    done = command("fit", "none.npz", "-o", "s.npz")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == ("jaxfit: error: none.npz does not exist; check its name and folder.\n")
