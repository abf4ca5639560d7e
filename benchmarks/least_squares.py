"""One least-squares solve with given parameters, beside SciPy's design matrix and CHOLMOD, in one run.

    python benchmarks/least_squares.py [--turns 7] [--case 0 1 2]

Both are called as a user would: NumPy arrays of points, parameters and knots go in, and a NumPy array of
control points comes out, all of them free. Ours is one public call, which also checks its arguments and
measures the errors at the parameters. SciPy's takes `NdBSpline.design_matrix`, the normal matrix, and
CHOLMOD of scikit-sparse with its analysis of the pattern; where that is missing, SciPy's own `splu`. The thin
plate's matrix is given to it. They take turns, so that both meet the same machine.

Printed are the median times with the lowest and the highest, the first call, which compiles, the ratio of
the medians, and the largest difference of the control points as a fraction of the diagonal of the cloud's
bounding box.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np
import scipy.sparse
from scipy.interpolate import NdBSpline
from scipy.sparse.linalg import splu

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers
from normal_reference import squares

import jaxfit as jf

try:
    from sksparse.cholmod import cholesky
except ImportError:
    cholesky = None

CASES = ((11_500, 42, 42), (100_000, 62, 57), (1_000_000, 62, 57))
SMOOTHING = 2e-5


def cloud(count):
    """Random places on a bumpy height field."""
    u, v = np.random.default_rng(0).random((2, count))
    z = 0.2 * np.sin(9 * u) * np.cos(7 * v) + 0.02 * np.sin(60 * u * v)
    return u, v, np.stack([u + 0.05 * np.sin(5 * v), v, z], axis=-1)


def flat_net(knots):
    """Control points (nu, nv, 3) of the unit square in the plane z = 0."""
    greville = (np.convolve(k[1:-1], np.ones(3) / 3, "valid") for k in knots)
    x, y = np.meshgrid(*greville, indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def ours(knots, net, u, v, points, smoothing):
    """The public call, which solves once: no surface meets a tolerance of 0."""
    method = jf.StandardApproximation(smoothing, parameter_correction=False, border=jf.FreeBorder())
    base = jf.BSplineSurface(net, *knots)
    options = dict(start=(u, v), tol_average=0.0, max_steps=1, errors=jf.AtParameters())
    return np.asarray(jf.approximate(points, base, method, **options).surface.control_points)


def scipys(knots, shape, u, v, points, plate):
    """The design matrix, the normal matrix, and a sparse Cholesky factorisation."""
    a = NdBSpline.design_matrix(np.stack([u, v], axis=-1), knots, 3)
    matrix = a.T @ a if plate is None else a.T @ a + plate
    solve = cholesky(matrix.tocsc()) if cholesky else splu(matrix.tocsc()).solve
    return solve(a.T @ points).reshape(shape)


def plate_of(knots, shape):
    """The matrix of the thin plate, equation (10)."""
    (u0, u1, u2), (v0, v1, v2) = (squares(k, n) for k, n in zip(knots, shape[:2], strict=True))
    parts = ((u2, v0, 1), (u1, v1, 2), (u0, v2, 1))
    sparse = [scipy.sparse.kron(*(scipy.sparse.csr_matrix(x) for x in (f * a, b))) for a, b, f in parts]
    total = (sparse[0] + sparse[1] + sparse[2]).tocsr()
    total.data[np.abs(total.data) < 1e-14 * np.abs(total.data).max()] = 0.0
    total.eliminate_zeros()
    return total


def timed(work):
    """Seconds and the result."""
    begun = time.perf_counter()
    result = work()
    return time.perf_counter() - begun, result


def report(title, works, turns, diagonal):
    """Times in turns, their ratio, and how far the two are apart."""
    begun = [timed(work) for work in works.values()]
    times = np.array([[timed(work)[0] for work in works.values()] for _ in range(turns)])
    apart = np.abs(begun[0][1] - begun[1][1]).max() / diagonal
    medians = np.median(times, axis=0)
    print(title)
    for k, name in enumerate(works):
        low, high = 1e3 * times[:, k].min(), 1e3 * times[:, k].max()
        spent = f"{1e3 * medians[k]:>9.1f} ms  [{low:.1f}, {high:.1f}]"
        print(f"  {name:<20}{spent}   first {1e3 * begun[k][0]:.0f} ms")
    print(f"  {medians[0] / medians[1]:.3f} times its time, control points apart {apart:.1e}", flush=True)


def main():
    """Print all cases."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--case", type=int, nargs="*", default=range(len(CASES)))
    options = parser.parse_args()
    other = "SciPy + CHOLMOD" if cholesky else "SciPy + splu"
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64, order (4, 4), all control points free")
    if not cholesky:
        print("scikit-sparse is not installed: SciPy's splu stands in for CHOLMOD")
    for count, nu, nv in (CASES[i] for i in options.case):
        u, v, points = cloud(count)
        knots = tuple(helpers.clamped_uniform(n, 4) for n in (nu, nv))
        net = flat_net(knots)
        for smoothing in (0.0, SMOOTHING):
            plate = smoothing * plate_of(knots, net.shape) if smoothing else None
            works = {
                "jaxfit": lambda a=(knots, net, u, v, points, smoothing): ours(*a),
                other: lambda a=(knots, net.shape, u, v, points, plate): scipys(*a),
            }
            title = f"{count} points, {nu}x{nv}, lambda {smoothing:g}"
            report(title, works, options.turns, helpers.diagonal(points))


if __name__ == "__main__":
    main()
