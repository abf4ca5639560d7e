"""Fits of many small clouds: `jax.vmap` beside `jax.lax.map` and a Python loop over the jitted single fit.

    python benchmarks/batches.py [--clouds 32] [--runs 5] [--methods geometric standard orthogonal]

Each cloud has 300 points, the net is 8 x 8, and every fit takes 20 steps, all from one base surface. The
three take turns. Printed are the first call, which compiles, the median time of a later one with the lowest
and the highest, the time as a multiple of the loop's, and the largest difference of a control point from the
loop's, as a fraction of the diagonal of the clouds' bounding box. Orthogonal distance leaves the net some
freedom along the surface, so that rounding grows there from step to step.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers

import jaxfit as jf

POINTS, NET, STEPS = 300, 8, 20
METHODS = {
    "geometric": jf.GeometricApproximation(),
    "standard": jf.StandardApproximation(),
    "orthogonal": jf.OrthogonalDistance(),
}


def wavy(x, y):
    """Heights that all clouds share on the border, which the fits hold."""
    return 0.1 * np.sin(3.0 * x + 0.5) * np.cos(2.5 * y)


def made_clouds(count):
    """Clouds (count, 300, 3) at random places, each with a bump of its own."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(size=(2, count, POINTS))
    bump = rng.uniform(-0.1, 0.1, (count, 1)) * np.sin(np.pi * x) * np.sin(np.pi * y)
    return np.stack([x, y, wavy(x, y) + bump], axis=-1)


def base_of_all():
    """A surface with the border of the clouds."""
    knots = helpers.clamped_uniform(NET, 4)
    greville = np.convolve(knots[1:-1], np.ones(3) / 3, "valid")
    x, y = np.meshgrid(greville, greville, indexing="ij")
    return jf.BSplineSurface(np.stack([x, y, wavy(x, y)], axis=-1), knots, knots)


def ways(method, clouds):
    """The three ways to fit all clouds; each gives control points (clouds, 8, 8, 3)."""
    base = base_of_all()

    def fitted(points):
        fit = jf.approximate(points, base, method, tol_average=0.0, max_steps=STEPS)
        return fit.surface.control_points

    single, batch = jax.jit(fitted), jax.jit(jax.vmap(fitted))
    one_by_one = jax.jit(lambda clouds: jax.lax.map(fitted, clouds))
    apart = list(jnp.asarray(clouds))
    together = jnp.asarray(clouds)
    return {
        "Python loop": lambda: jnp.stack(jax.block_until_ready([single(points) for points in apart])),
        "vmap": lambda: jax.block_until_ready(batch(together)),
        "lax.map": lambda: jax.block_until_ready(one_by_one(together)),
    }


def timed(work):
    """Seconds and the result."""
    begun = time.perf_counter()
    result = work()
    return time.perf_counter() - begun, np.asarray(result)


def main():
    """Print a line for each method and way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clouds", type=int, default=32)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=METHODS)
    options = parser.parse_args()
    clouds = made_clouds(options.clouds)
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64; ", end="")
    print(f"{options.clouds} clouds of {POINTS} points, {NET}x{NET} net, {STEPS} steps")
    for name in options.methods:
        works = ways(METHODS[name], clouds)
        begun = {way: timed(work) for way, work in works.items()}
        times = {way: [] for way in works}
        for _ in range(options.runs):
            for way, work in works.items():
                times[way].append(timed(work)[0])
        usual, loop = np.median(times["Python loop"]), begun["Python loop"][1]
        for way, spent in times.items():
            difference = np.abs(begun[way][1] - loop).max() / helpers.diagonal(clouds)
            print(
                f"{name:<12}{way:<13}{np.median(spent):>8.3f} s [{min(spent):.3f}, {max(spent):.3f}]"
                f"   first {begun[way][0]:6.2f} s   {np.median(spent) / usual:>6.2f} times the loop's"
                f"   differs by {difference:.1e}",
                flush=True,
            )


if __name__ == "__main__":
    main()
