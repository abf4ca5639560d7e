"""Seconds of the first and of a later call, each in a process of its own that has no compilation cache.

The calls are `closest_point`, `interpolate` and `approximate` with each method, on a made cloud of 3,000
points, a 16 x 14 net and a grid of 20 x 24 points. The first call compiles; the later one is the median of
three in the same process, whose peak memory is that of all of them. The environment variable JAXFIT_OTHER may
name a second checkout of jaxfit: both then take turns, to meet the same machine.
"""

import json
import os
import resource
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
    """Closest points of the cloud."""
    return jf.closest_point(data.base, data.cloud)


def interpolated(jf, data, method):
    """A surface through the grid."""
    return jf.interpolate(data.grid, method)


def approximated(jf, data, method):
    """A surface near the cloud."""
    return jf.approximate(data.cloud, data.base, method, tol_average=2e-4, max_steps=50)


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
    """In a process of its own: seconds of the first and a later call, memory, errors, where jaxfit lies."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxfit as jf

    jax.devices()  # JAX starts before the clock does
    data, seconds = Data(jf), []
    for _ in range(1 + LATER):
        begun = time.perf_counter()
        result = jax.block_until_ready(CALLS[name](jf, data))
        seconds.append(time.perf_counter() - begun)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    times = {"first": seconds[0], "later": float(np.median(seconds[1:])), "peak": peak}
    return {**times, "errors": errors(name, data, result), "file": jf.__file__}


def errors(name, data, result):
    """By the referee: of closest points, how much farther they are than its own."""
    sys.path.insert(0, str(HERE))
    from benchmarks._referee import distances, folds, judged

    surface = getattr(result, "surface", data.base)
    surface = surface.control_points, (surface.knots_u, surface.knots_v)
    if name != "closest point":
        return judged(*surface, data.grid if name.startswith("interpolate") else data.cloud)
    farther = np.maximum(np.asarray(result.distance) - distances(*surface, data.cloud), 0.0)
    farther *= 100 / np.linalg.norm(np.ptp(data.cloud, axis=0))
    return {"average %": farther.mean(), "maximum %": farther.max(), "folds": folds(*surface)}


def in_new_process(name, checkout):
    """`measured` with the jaxfit of `checkout`."""
    environment = {key: x for key, x in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    path = os.pathsep.join(filter(None, [str(checkout), os.environ.get("PYTHONPATH")]))
    environment |= {"JAX_ENABLE_COMPILATION_CACHE": "false", "PYTHONPATH": path}
    command = [sys.executable, str(Path(__file__).resolve()), name]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{name} fails with {checkout}:\n{done.stderr}")
    found = json.loads(done.stdout.splitlines()[-1])
    if not Path(found["file"]).is_relative_to(checkout):
        sys.exit(f"{checkout} has no jaxfit: {found['file']} was imported")
    return found


def calls(report, options):
    """First and later calls of the public entries."""
    note = (
        "Seconds; medians over the processes, the first call with its spread. Peak memory is in MiB. Errors "
    )
    note += "of closest points are how much farther they are than the referee's."
    report.table("First calls", note)
    checkouts = {"this": HERE}
    if os.environ.get("JAXFIT_OTHER"):
        checkouts["other"] = Path(os.environ["JAXFIT_OTHER"]).resolve()
    for name in list(CALLS)[: 1 if options.quick else None]:
        times = {key: [] for key in checkouts}
        for _ in range(min(options.runs, 3)):
            for key, checkout in checkouts.items():
                times[key].append(in_new_process(name, checkout))
        for key, found in times.items():
            first, later, peak = (np.array([x[key] for x in found]) for key in ("first", "later", "peak"))
            report.row(
                call=name,
                checkout=key,
                first_s=float(np.median(first)),
                lowest_s=float(first.min()),
                highest_s=float(first.max()),
                later_s=float(np.median(later)),
                peak_MiB=float(np.median(peak)),
                **found[0]["errors"],
            )


PARTS = {"calls": calls}

if __name__ == "__main__":
    print(json.dumps(measured(sys.argv[1]), default=float))
