"""Local mode: fit only where the error exceeds the tolerance, against fitting everywhere.

    python -m benchmarks local [--data FOLDER] [--runs 3]

On the terrain `jacksboro_dem` as a cloud. Prints iterations, points that pull, control points that have not
changed in any bit, and times.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers

import jaxfit as jf


def problems(folder):
    """Name, points, base, start, tolerance on the maximum error."""
    with np.load(folder / "jacksboro_dem.npz") as arrays:
        grid = arrays["grid"]
    boundary = jf.Boundary(**helpers.grid_edges(grid))
    base = jf.base_surface(boundary, net=(62, 57))
    points = grid.reshape(-1, 3)
    base = jf.approximate(points, base, jf.StandardApproximation(), max_steps=1, tol_average=0.0).surface
    yield "jacksboro_dem", points, base, None, 2.3e-3


def main():
    parser = argparse.ArgumentParser(description="local mode against global fits")
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    heads = ("steps", "max %", "avg %", "pulling", "untouched", "s")
    print(("{:<16}{:<8}" + "{:>7}{:>9}{:>9}{:>20}{:>12}{:>8}").format("data", "mode", *heads))
    for name, points, base, start, target in problems(options.data):
        for mode, local in (("global", False), ("local", True)):
            method = jf.GeometricApproximation(local=local)

            def fit(method=method, points=points, base=base, start=start, target=target):
                begun = time.perf_counter()
                options = dict(tol_average=None, tol_maximum=target, max_steps=60, start=start)
                found = jf.approximate(points, base, method, **options)
                return found, time.perf_counter() - begun

            found = fit()[0]
            seconds = [fit()[1] for _ in range(options.runs)]
            same = np.asarray(found.surface.control_points == base.control_points).all(axis=-1)
            active = np.asarray(found.history.active)
            pulling = f"{active.max()} .. {active[:-1].min() if active.size > 1 else active[0]}"
            print(
                f"{name:<16}{mode:<8}{int(found.stats['num_steps']):>7}"
                f"{100 * float(found.maximum_error):>9.4f}{100 * float(found.average_error):>9.4f}"
                f"{pulling:>20}{int(same.sum()):>6}/{same.size:<5}{np.median(seconds):>8.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
