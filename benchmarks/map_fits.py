"""Many fits of small clouds: `map_fits` by threads and by processes beside Python loops and one program.

    python benchmarks/map_fits.py [--clouds 64] [--points 3000] [--net 11x15] [--runs 3]

All fits take 20 steps from one base surface. The ways take turns. Printed are the first call, which compiles
(or starts the processes), fits a second in a later one (the best run: others may use the machine), that as a
multiple of a Python loop over the jitted fit, processor milliseconds a fit (of this process, not of the
workers), and the largest difference of a control point from the loop over `approximate`, as a fraction of
the diagonal.
"""

import argparse
import os
import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import helpers

import jaxfit as jf

STEPS = 20
METHODS = {
    "geometric": jf.GeometricApproximation(),
    "standard": jf.StandardApproximation(smoothing=1e-5),
    "orthogonal": jf.OrthogonalDistance(),
}
OPTIONS = {"tol_average": 0.0, "max_steps": STEPS}


def wavy(x, y):
    """Heights that all clouds share on the border, which the fits hold."""
    return 0.1 * np.sin(3.0 * x + 0.5) * np.cos(2.5 * y)


def made_clouds(count, points):
    """Clouds (count, points, 3) at random places, each with a bump of its own."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(size=(2, count, points))
    bump = rng.uniform(-0.1, 0.1, (count, 1)) * np.sin(np.pi * x) * np.sin(np.pi * y)
    return np.stack([x, y, wavy(x, y) + bump], axis=-1)


def base_of_all(net):
    """A surface with the border of the clouds."""
    knots = [helpers.clamped_uniform(n, 4) for n in net]
    greville = [np.convolve(k[1:-1], np.ones(3) / 3, "valid") for k in knots]
    x, y = np.meshgrid(*greville, indexing="ij")
    return jf.BSplineSurface(np.stack([x, y, wavy(x, y)], axis=-1), *knots)


def nets(fits):
    """Control points of all fits."""
    return np.stack([np.asarray(fit.surface.control_points) for fit in fits])


def ways(method, clouds, base, executor):
    """The ways to fit all clouds; each gives control points."""

    def net(points):
        return jf.approximate(points, base, method, **OPTIONS).surface.control_points

    single, program = jax.jit(net), jax.jit(lambda clouds: jax.lax.map(net, clouds))
    apart, together = list(jnp.asarray(clouds)), jnp.asarray(clouds)
    return {
        "loop, approximate": lambda: np.stack([np.asarray(net(points)) for points in clouds]),
        "loop, jit": lambda: np.stack([np.asarray(single(points)) for points in apart]),
        "lax.map": lambda: np.asarray(program(together)),
        "map_fits, threads": lambda: nets(jf.map_fits(clouds, base, method, **OPTIONS)),
        "map_fits, processes": lambda: nets(jf.map_fits(clouds, base, method, executor=executor, **OPTIONS)),
    }


def timed(work):
    """Seconds, processor seconds of this process, and the result."""
    begun, used = time.perf_counter(), time.process_time()
    result = work()
    return time.perf_counter() - begun, time.process_time() - used, result


def main():
    """Print a line for each method and way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clouds", type=int, default=64)
    parser.add_argument("--points", type=int, default=3000)
    parser.add_argument("--net", default="11x15")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=METHODS)
    options = parser.parse_args()
    clouds, base = made_clouds(options.clouds, options.points), base_of_all(map(int, options.net.split("x")))
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64, {os.cpu_count()} cores; ", end="")
    print(f"{options.clouds} clouds of {options.points} points, {options.net} net, {STEPS} steps")
    with jf.worker_processes() as executor:
        for name in options.methods:
            report(name, ways(METHODS[name], clouds, base, executor), options)


def report(name, works, options):
    """Run the ways in turns, and print a line for each."""
    first = {way: timed(work) for way, work in works.items()}
    runs = {way: [] for way in works}
    for _ in range(options.runs):
        for way, work in works.items():
            runs[way].append(timed(work)[:2])
    reference = first["loop, approximate"][2]
    best = {way: min(seconds for seconds, _ in times) for way, times in runs.items()}
    for way, times in runs.items():
        difference = np.abs(first[way][2] - reference).max() / helpers.diagonal(reference)
        print(
            f"{name:<11}{way:<20}{options.clouds / best[way]:>8.1f} fits/s"
            f"{best['loop, jit'] / best[way]:>7.2f} times the loop over jit"
            f"   processor {1e3 * min(used for _, used in times) / options.clouds:>6.1f} ms a fit"
            f"   first {first[way][0]:6.2f} s   differs by {difference:.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
