"""`fit_points` without a net: the one it chooses for a tolerance, and what it makes of noise.

    python -m benchmarks growing_net [--data FOLDER] [--part tolerance noise] [name ...]

`tolerance`: net, errors in % of the diagonal, folds and seconds (a second call, which compiles nothing), and
the same of nets tried one by one, about a quarter finer each time, until one meets the tolerance.
`noise`: noise of 0.1, 0.3 and 1 % of the diagonal, and the average distance of the clean points from the
surface; beside it the least of all nets and smoothings tried.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import helpers

import jaxfit as jf

TARGETS = {
    "igea_face": 3e-4,
    "mannequin_head": 8e-4,
    "mountain": 3e-4,
    "blade_wrap_3000": 6e-4,
    "jacksboro_dem": 2e-4,
}
NOISY = ("igea_face", "mountain", "mannequin_head")
NOISE = (0.001, 0.003, 0.01)
SIZES = (8, 10, 13, 16, 20, 25, 32, 40, 50, 64)
NOISE_SIZES = (8, 12, 18, 27, 40, 60)
SMOOTHINGS = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5)


def load(folder, name):
    """Points and boundary of a data set."""
    with np.load(folder / f"{name}.npz") as arrays:
        if "grid" in arrays:
            grid = arrays["grid"]
            return grid.reshape(-1, 3), jf.Boundary.from_grid(grid)
        sides = (arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1"))
        return arrays["points"], jf.Boundary(*sides)


def shape(boundary, size):
    """About `size` squared control points, by the lengths of the sides."""
    sides = (boundary.v0, boundary.v1, boundary.u0, boundary.u1)
    lengths = [np.linalg.norm(np.diff(np.asarray(x), axis=0), axis=1).sum() for x in sides]
    ratio = np.sqrt((lengths[0] + lengths[1]) / (lengths[2] + lengths[3]))
    return max(8, round(size * ratio)), max(8, round(size / ratio))


def line(name, label, fit, seconds, more=""):
    print(
        f"{name:<16}{label:<10}{'{} x {}'.format(*fit.surface.shape):>9}"
        f"{100 * float(fit.average_error):>10.4f}"
        f"{100 * float(fit.maximum_error):>9.3f}{fit.regularity.folds:>7}{seconds:>8.1f}{more}",
        flush=True,
    )


def timed(points, boundary, **options):
    """The fit, and the seconds of a second call."""
    jf.fit_points(points, boundary, **options)
    begun = time.perf_counter()
    fit = jf.fit_points(points, boundary, **options)
    return fit, time.perf_counter() - begun


def error(fit, points):
    """Average distance of the points from the surface, in % of their diagonal."""
    return 100 * float(np.mean(jf.closest_point(fit.surface, points).distance)) / helpers.diagonal(points)


def tolerance_part(folder, names):
    print(f"{'':<26}{'net':>9}{'average':>10}{'maximum':>9}{'folds':>7}{'time/s':>8}")
    for name in names or TARGETS:
        points, boundary = load(folder, name)
        goal = TARGETS[name]
        fit, seconds = timed(points, boundary, tol_average=goal)
        line(name, "grown", fit, seconds, "" if fit.converged else f"  {fit.message}")
        for size in SIZES:
            net = shape(boundary, size)
            begun = time.perf_counter()
            fit = jf.fit_points(points, boundary, net=net, tol_average=goal)
            if fit.converged or size == SIZES[-1]:
                line(name, "by hand", fit, time.perf_counter() - begun)
                break


def noise_part(folder, names):
    heads = "net", "clean", "folds", "time/s", "best", "net", "lambda", "ratio"
    print(("{:<16}{:>7}" + "{:>9}" * 8).format("", "noise", *heads))
    for name in names or NOISY:
        points, boundary = load(folder, name)
        size = helpers.diagonal(points)

        for noise in NOISE:
            normal = np.random.default_rng(0).normal(size=points.shape)
            noisy = points + noise * size / np.sqrt(3) * normal
            begun = time.perf_counter()
            fit = jf.fit_points(noisy, boundary, tol_average=1e-6)
            seconds = time.perf_counter() - begun
            best = np.inf, None, None
            for n in NOISE_SIZES:
                net = shape(boundary, n)
                base = jf.base_surface(boundary, noisy, net=net, method=jf.Meshless())
                for value in SMOOTHINGS:
                    method = jf.OrthogonalDistance(smoothing=value)
                    tried = jf.approximate(noisy, base, method, tol_average=1e-6, max_steps=20)
                    best = min(best, (error(tried, points), "{} x {}".format(*net), value))
            print(
                f"{name:<16}{100 * noise:>6.1f}%{'{} x {}'.format(*fit.surface.shape):>9}"
                f"{error(fit, points):>9.4f}"
                f"{fit.regularity.folds:>9}{seconds:>9.1f}{best[0]:>9.4f}{best[1]:>9}{best[2]:>9.0e}"
                f"{error(fit, points) / best[0]:>9.2f}",
                flush=True,
            )


PARTS = {"tolerance": tolerance_part, "noise": noise_part}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="data sets (default all)")
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    parser.add_argument("--part", nargs="*", default=list(PARTS), choices=PARTS)
    options = parser.parse_args()
    for part in options.part:
        PARTS[part](options.data, options.names)


if __name__ == "__main__":
    main()
