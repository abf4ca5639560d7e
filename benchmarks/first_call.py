"""Seconds of the first and of a later call, each in a process of its own that has no compilation cache.

    python benchmarks/first_call.py [--other PATH] [--runs 3] [--calls CALL ...]

The calls are `closest_point`, `interpolate` and `approximate` with each method, on a made cloud of 3,000
points, a 16 x 14 net and a grid of 20 x 24 points. The first call compiles; the later one is the median of
three in the same process. `--other` is a second checkout of jaxfit, put first on the path: both then take
turns, so that they meet the same machine. Printed are medians over the runs with the lowest and the highest,
and, of the other checkout, the seconds of its first call beyond those of a later one, as a multiple of ours.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parents[1]
COUNT, NET, GRID = 3_000, (16, 14), (20, 24)
LATER = 3


def height(x, y):
    """Points of a wavy height field."""
    return np.stack([x, y, 0.1 * np.sin(3.0 * x + 0.5) * np.cos(2.5 * y)], axis=-1)


def greville(count):
    """Clamped uniform knots on [0, 1] and the abscissae of their control points."""
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, count - 2), np.ones(3)])
    return knots, np.convolve(knots[1:-1], np.ones(3) / 3, "valid")


class Data:
    """A cloud, a base surface and a grid, made with NumPy so that nothing compiles."""

    def __init__(self, jf):
        (knots_u, at_u), (knots_v, at_v) = (greville(n) for n in NET)
        self.cloud = height(*np.random.default_rng(0).uniform(size=(2, COUNT)))
        self.base = jf.BSplineSurface(height(*np.meshgrid(at_u, at_v, indexing="ij")), knots_u, knots_v)
        self.grid = height(*np.meshgrid(*(np.linspace(0, 1, n) for n in GRID), indexing="ij"))


def closest(jf, data):
    """Arrays of a closest-point search."""
    feet = jf.closest_point(data.base, data.cloud)
    return feet.u, feet.v, feet.distance


def interpolated(jf, data, method):
    """Arrays of a surface through the grid."""
    fit = jf.interpolate(data.grid, method)
    return fit.surface.control_points, fit.errors


def approximated(jf, data, method):
    """Arrays of a surface near the cloud."""
    fit = jf.approximate(data.cloud, data.base, method, tol_average=2e-4, max_steps=50)
    return fit.surface.control_points, fit.errors


CALLS = {
    "closest point": closest,
    "interpolate, geometric": lambda jf, data: interpolated(jf, data, jf.GeometricInterpolation()),
    "interpolate, standard": lambda jf, data: interpolated(jf, data, jf.StandardInterpolation()),
    "approximate, geometric": lambda jf, data: approximated(jf, data, jf.GeometricApproximation()),
    "approximate, paper's": lambda jf, data: approximated(jf, data, jf.GeometricApproximation.paper()),
    "approximate, standard": lambda jf, data: approximated(jf, data, jf.StandardApproximation()),
    "approximate, orthogonal": lambda jf, data: approximated(jf, data, jf.OrthogonalDistance()),
}


def measured(name):
    """In a process of its own: seconds of the first call and of a later one, and where jaxfit lies."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxfit as jf

    jax.devices()  # JAX starts before the clock does
    data, seconds = Data(jf), []
    for _ in range(1 + LATER):
        begun = time.perf_counter()
        jax.block_until_ready(CALLS[name](jf, data))
        seconds.append(time.perf_counter() - begun)
    return {"first": seconds[0], "later": float(np.median(seconds[1:])), "file": jf.__file__}


def in_new_process(name, checkout):
    """`measured` with the jaxfit of `checkout`: seconds of the first call and of a later one."""
    environment = {key: x for key, x in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"JAX_ENABLE_COMPILATION_CACHE": "false", "PYTHONPATH": paths(checkout)}
    command = [sys.executable, str(Path(__file__).resolve()), "--measure", name]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{name} fails with {checkout}:\n{done.stderr}")
    report = json.loads(done.stdout.splitlines()[-1])
    if not Path(report["file"]).is_relative_to(checkout):
        sys.exit(f"{checkout} has no jaxfit: {report['file']} was imported")
    return report["first"], report["later"]


def paths(checkout):
    """The checkout, then what the path holds already."""
    return os.pathsep.join(filter(None, [str(checkout), os.environ.get("PYTHONPATH")]))


def cells(times):
    """First and later call as text: median, lowest and highest."""
    parts = [f"{np.median(x):8.3f} [{np.min(x):.3f}, {np.max(x):.3f}]" for x in np.transpose(times)]
    return "".join(f"{part:<27}" for part in parts)


def main():
    """Print a line for each call and checkout."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--other", type=Path, help="a second checkout of jaxfit, for instance an older one")
    parser.add_argument("--runs", type=int, default=3, help="processes for each call and checkout")
    parser.add_argument("--calls", nargs="*", default=list(CALLS), choices=CALLS, metavar="CALL")
    parser.add_argument("--measure", choices=CALLS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measured(options.measure)))
        return
    checkouts = {"this": HERE} | ({"other": options.other.resolve()} if options.other else {})
    print(f"{'':<24}{'':<7}{'first call, s':<27}{'later call, s':<27}")
    for name in options.calls:
        times = {key: [] for key in checkouts}
        for _ in range(options.runs):
            for key, checkout in checkouts.items():
                times[key].append(in_new_process(name, checkout))
        beyond = {key: np.median(-np.diff(x)) for key, x in times.items()}
        for key, x in times.items():
            note = (
                f"{beyond[key] / beyond['this']:.2f} times our seconds beyond a later call"
                if key == "other"
                else ""
            )
            print(f"{name:<24}{key:<7}{cells(x)}{note}", flush=True)


if __name__ == "__main__":
    main()
