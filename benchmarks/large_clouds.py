"""Fits of large clouds in memory: seconds an iteration, seconds outside the loop, and memory.

    python -m benchmarks large_clouds [--points 11500 100000 1000000] [--net 42 42]
        [--method geometric standard orthogonal] [--runs 3]

A made cloud with noise, fitted from a base of some of its points, `Meshless` as `fit_points` takes. Each size
and method has a process of its own, whose greatest resident memory is its own. From medians of public
calls: an iteration is the time of 26 iterations less that of 6, over 20; outside the loop is what 6
iterations leave of a call of 6.
MB are the greatest memory of the first call less that before it. Programs and their compilation are in it, so
that bytes a point are the difference of two large sizes over their points.
"""

import argparse
import resource
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]
jax.config.update("jax_enable_x64", True)

import jaxfit as jf
from benchmarks._timing import seconds

NOISE = 2e-4
FEW, MANY = 6, 26
POINTS_OF_BASE = 12_000
METHODS = {
    "geometric": jf.GeometricApproximation,
    "standard": jf.StandardApproximation,
    "orthogonal": jf.OrthogonalDistance,
}


def sheet(u, v):
    return np.stack([u, v, 0.2 * np.sin(9 * u) * np.cos(7 * v)], axis=-1)


def cloud(count):
    """Noisy points at random places of a sheet, and its boundary."""
    rng = np.random.default_rng(0)
    line, zero, one = np.linspace(0, 1, 200), np.zeros(200), np.ones(200)
    sides = ((line, zero), (line, one), (zero, line), (one, line))
    points = sheet(*rng.random((2, count))) + NOISE * rng.normal(size=(count, 3))
    return points, jf.Boundary(*(sheet(*x) for x in sides))


def memory():
    """The greatest resident memory of this process, in bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def fit_one(count, name, options):
    """A row, measured in this process."""
    points, boundary = cloud(count)
    some = points[:: max(count // POINTS_OF_BASE, 1)]
    base = jf.base_surface(boundary, some, options.net, method=jf.Meshless())

    def fit(steps):
        return jf.approximate(points, base, METHODS[name](), tol_average=1e-9, max_steps=steps)

    before = memory()
    first, _ = seconds(lambda: fit(FEW))
    most = memory() - before
    timed = {steps: [] for steps in (FEW, MANY)}
    for _ in range(options.runs):
        for steps, times in timed.items():
            took, last = seconds(lambda steps=steps: fit(steps))
            times.append(took)
    few, many = (float(np.median(timed[x])) for x in (FEW, MANY))
    iteration = (many - few) / (MANY - FEW)
    outside = few - FEW * iteration
    print(
        f"{count:>10,}  {name:<12}{first:>8.1f}{few:>9.3f}{outside:>9.3f}{1e3 * iteration:>14.2f}"
        f"{most / 1e6:>8.0f}{100 * float(last.average_error):>12.4f}{last.folds:>7}",
        flush=True,
    )


def main():
    """A row for every size and method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="*", default=[11_500, 100_000, 1_000_000])
    parser.add_argument("--net", type=int, nargs=2, default=[42, 42])
    parser.add_argument("--method", nargs="*", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--here", action="store_true", help="measure in this process")
    options = parser.parse_args()
    if options.here:
        for count in options.points:
            for name in options.method:
                fit_one(count, name, options)
        return
    net = "x".join(map(str, options.net))
    print(f"jax {jax.__version__}, {jax.default_backend()}, net {net}, medians of {options.runs} calls")
    print(
        f"{'points':>10}  {'method':<12}{'first s':>8}{f'{FEW} it. s':>9}{'outside':>9}{'iteration ms':>14}"
        f"{'MB':>8}{'average %':>12}{'folds':>7}",
        flush=True,
    )
    rest = ["--net", *map(str, options.net), "--runs", str(options.runs), "--here"]
    for count in options.points:
        for name in options.method:
            one = ["--points", str(count), "--method", name, *rest]
            subprocess.run([sys.executable, "-m", "benchmarks", "large_clouds", *one], check=True)


if __name__ == "__main__":
    main()
