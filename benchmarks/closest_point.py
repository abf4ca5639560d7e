"""Closest points: time a point, warm and cold, and how many feet are wrong.

    python -m benchmarks closest_point [--points 100000] [--runs 9] [--data FOLDER]

Queries lie 1-5 % of the diagonal off the surface. Times are medians over the runs, with the spread (lowest
to highest); the first call, which compiles, is listed apart. A foot is wrong if a dense sampling with a
derivative-free polish of every valley finds one nearer by more than 1e-9 of the diagonal.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import closest_reference
import helpers

import jaxfit as jf

BASES = {"blade_wrap_3000": (24, 40), "mannequin_head": (42, 42)}


def timed(work, runs):
    """First call, then median, lowest and highest of `runs` more, in seconds; and the last result."""
    times = []
    for _ in range(runs + 1):
        begin = time.perf_counter()
        result = jax.block_until_ready(work())
        times.append(time.perf_counter() - begin)
    return times[0], np.median(times[1:]), min(times[1:]), max(times[1:]), result


def line(name, count, first, median, low, high, note=""):
    per = 1e6 / count
    print(
        f"{name:<34} {median * per:7.3f} us  [{low * per:.3f}, {high * per:.3f}]   "
        f"first {first:5.2f} s   {note}",
        flush=True,
    )


def off_surface(surface, count, seed=0):
    """Queries 1-5 % of the diagonal off the surface, with the parameters below them."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(size=(2, count))
    height = rng.choice([-1, 1], count) * rng.uniform(0.01, 0.05, count)
    height *= helpers.diagonal(surface.control_points)
    return np.asarray(surface(u, v)) + height[:, None] * np.asarray(surface.normal(u, v)), u, v


def verdict(surface, points, feet, expected=None):
    """How many have not converged, and how many are wrong."""
    if expected is None:
        expected = closest_reference.nearest_distance(surface, points)
    excess = (np.asarray(feet.distance) - expected) / helpers.diagonal(surface.control_points)
    lost, wrong = int((~np.asarray(feet.converged)).sum()), int((excess > 1e-9).sum())
    return f"{lost} not converged, {wrong} wrong (excess at most {max(excess.max(), 0):.1e})"


def wavy(count, runs):
    """The figures for a wavy 42 x 42 surface, and where the time goes."""
    knots = helpers.clamped_uniform(42, 4)
    surface = jf.BSplineSurface(helpers.wavy_net(42, 42), knots, knots)
    points, u, v = off_surface(surface, count)
    *times, feet = timed(lambda: jf.closest_point(surface, points), runs)
    expected = closest_reference.nearest_distance(surface, points)
    line("wavy 42x42, cold", count, *times, verdict(surface, points, feet, expected))
    shift = np.random.default_rng(1).uniform(-0.01, 0.01, (2, count))
    start = (u + shift[0], v + shift[1])
    for method in (jf.Newton(), jf.HuWallner()):
        *times, feet = timed(lambda m=method: jf.closest_point(surface, points, start, m), runs)
        lost = int((~np.asarray(feet.converged)).sum())
        line(f"wavy 42x42, warm, {type(method).__name__}", count, *times, f"{lost} not converged")
    on_device = jax.device_put((points, *start))
    *times, _ = timed(lambda: jf.closest_point(surface, on_device[0], on_device[1:]), runs)
    line("wavy 42x42, warm, arrays on device", count, *times)


def bases(folder, runs):
    """Coons bases of two scans: folded, unevenly spaced, queried by their clouds and around."""
    for name, net in BASES.items():
        path = folder / f"{name}.npz"
        if not path.is_file():
            print(f"{name}: not in {folder}, left out")
            continue
        data = np.load(path)
        sides = jf.Boundary(*(data[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
        base = jf.base_surface(sides, data["points"], net=net)
        near, _, _ = off_surface(base, 20_000)
        box = data["points"].min(axis=0), data["points"].max(axis=0)
        around = np.random.default_rng(4).uniform(*box, (5_000, 3))
        for kind, points in (("cloud", data["points"]), ("1-5 % off", near), ("box", around)):
            *times, feet = timed(lambda q=points, s=base: jf.closest_point(s, q), runs)
            line(f"{name}, {kind}", len(points), *times, verdict(base, points, feet))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=100_000, help="queries on the wavy surface")
    parser.add_argument("--runs", type=int, default=9, help="timed calls of each kind, after one")
    parser.add_argument("--data", type=Path, default=helpers.FOLDER, help="folder of the .npz files")
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.default_backend()}, {os.cpu_count()} cores, float64; ", end="")
    print(f"median [lowest, highest] of {options.runs} runs, microseconds a point")
    wavy(options.points, options.runs)
    bases(options.data, options.runs)


if __name__ == "__main__":
    main()
