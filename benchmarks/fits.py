"""Fits of real data: errors, iterations, time of the first call and of later ones.

    python benchmarks/fits.py [--data FOLDER] [--runs N]

Grids are interpolated to 1e-10 % of the diagonal; clouds are approximated by plain Algorithm 1 from the
Coons surface of their four boundary polylines. Every cloud is fitted with the same fixed net throughout.
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

GRIDS = ("hood_beetle_10x10", "fuselage_d150_50x200", "fuselage_d150_100x400")
CLOUDS = {"jacksboro_dem": (62, 57), "mountain": (42, 42), "igea_face": (42, 42)}


def timed(fit, runs):
    begun = time.perf_counter()
    result = fit()
    first = time.perf_counter() - begun
    seconds = []
    for _ in range(runs):
        begun = time.perf_counter()
        fit()
        seconds.append(time.perf_counter() - begun)
    return result, first, np.sort(seconds)


def row(name, size, fit, first, seconds):
    middle, low, high = np.median(seconds), seconds[0], seconds[-1]
    print(
        f"{name:<24}{size:>10}{'{} x {}'.format(*fit.surface.shape):>10}{int(fit.stats['num_steps']):>6}"
        f"{100 * float(fit.average_error):>12.3e}{100 * float(fit.maximum_error):>12.3e}"
        f"{first:>9.2f}{middle:>9.3f} [{low:.3f}, {high:.3f}]  {fit.message}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description="fits of real data")
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--max-steps", type=int, default=200)
    parser.add_argument("--tol-average", type=float, default=0.0, help="per cent of the diagonal")
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64; errors in % of the diagonal, times in s")
    heads = ("data", "points", "net", "steps", "average", "maximum", "first", "later")
    print(("{:<24}{:>10}{:>10}{:>6}{:>12}{:>12}{:>9}{:>9}").format(*heads), "[lowest, highest]")
    for name in GRIDS:
        grid = np.load(options.data / f"{name}.npz")["grid"]
        fit, first, seconds = timed(lambda grid=grid: jf.interpolate(grid, tolerance=1e-12), options.runs)
        row(name, grid.shape[0] * grid.shape[1], fit, first, seconds)
    for name, net in CLOUDS.items():
        arrays = np.load(options.data / f"{name}.npz")
        if "grid" in arrays:
            points = arrays["grid"].reshape(-1, 3)
            boundary = jf.Boundary.from_grid(arrays["grid"])
        else:
            points = arrays["points"]
            boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))

        def whole(points=points, boundary=boundary, net=net):
            tolerance = options.tol_average / 100
            return jf.fit_points(
                points, boundary, net=net, tol_average=tolerance, max_steps=options.max_steps
            )

        fit, first, seconds = timed(whole, options.runs)
        row(name, len(points), fit, first, seconds)


if __name__ == "__main__":
    main()
