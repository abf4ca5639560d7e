"""A fit beside its gradient, by public calls: time, stationarity, and a central difference.

    python benchmarks/gradients.py --data FOLDER [--name igea_face] [--points 11500] [--net 42]
        [--smoothing 5e-6]

`--data` is the folder of the data sets that the tests use. The gradient is that of one height of the
surface in all points; its time includes the fit and the Newton steps to the surface at rest. Without
`--smoothing` the default smoothing takes part. Times are medians of three after the first call, which is
printed, too.
"""

import argparse
import statistics
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxfit as jf


def timed(work):
    begun = time.perf_counter()
    result = jax.block_until_ready(work())
    return result, time.perf_counter() - begun


def main():
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--name", default="igea_face")
    parser.add_argument("--points", type=int, default=11500)
    parser.add_argument("--net", type=int, default=42)
    parser.add_argument("--smoothing", type=float)
    options = parser.parse_args()
    with np.load(options.data / f"{options.name}.npz") as arrays:
        points = arrays["points"]
        boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
    rng = np.random.default_rng(0)
    points = points[rng.permutation(len(points))[: options.points]]
    base = jf.base_surface(boundary, points, net=(options.net,) * 2, method=jf.Meshless())
    smoothing = {} if options.smoothing is None else {"smoothing": options.smoothing}
    method = jf.OrthogonalDistance(**smoothing)

    def height(points, adjoint=None):
        fit = jf.approximate(points, base, method, tol_average=1e-9, errors=jf.LocalFeet(), adjoint=adjoint)
        return fit.surface(0.4, 0.6)[2], fit

    works = {
        "fit": lambda: height(points)[0],
        "gradient": lambda: jax.value_and_grad(height, has_aux=True)(points),
    }
    for name, work in works.items():
        result, first = timed(work)
        rest = statistics.median(timed(work)[1] for _ in range(3))
        print(f"{name:10} first {first:7.2f} s, then {rest:7.3f} s", flush=True)
    (_, fit), gradient = result
    print(f"stationarity {float(fit.stats['stationarity']):.1e}, steps {int(fit.stats['num_steps'])}")
    direction, step = rng.normal(size=points.shape), 1e-7 * float(fit.stats["diagonal"])
    ends = [height(points + sign * step * direction, jf.ImplicitAdjoint())[0] for sign in (1, -1)]
    difference = float(ends[0] - ends[1]) / (2 * step)
    slope = float(np.sum(np.asarray(gradient) * direction))
    print(f"along a random direction {slope:.9g}, central difference {difference:.9g}")


if __name__ == "__main__":
    main()
