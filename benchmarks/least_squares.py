"""One least-squares solve with given parameters, beside SciPy's design matrix and CHOLMOD, in one run.

    python benchmarks/least_squares.py [--turns 7] [--case 0 1 2]

Median times with the lowest and the highest, after the first call, which compiles. Both get points and
parameters on a uniform net whose border control points are held, and give control points. The root mean
square distance from the points follows, and the memory: ours what the compiled computation holds at most, its
inputs included, SciPy's what its arrays take at most beyond them. Ours is timed through optimistix, as
`StandardApproximation` solves it, and bare: moments, factors, one solve. Without scikit-sparse SciPy's own
`splu` takes CHOLMOD's part. They take turns, so that both meet the same machine.
"""

import argparse
import sys
import time
import tracemalloc
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers
from normal_reference import squares

from jaxfit._approximation._least_squares import GaussNewton, StructuredSolver, least_squares_problem
from jaxfit._fit._measure import border
from jaxfit._normal_equations import make_system
from jaxfit._splines._pieces import make_pieces

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


@jax.jit
def through_optimistix(pieces, net, u, v, points, smoothing):
    return GaussNewton()(_posed(pieces, net, u, v, points, smoothing))[0]


@jax.jit
def bare(pieces, net, u, v, points, smoothing):
    problem = _posed(pieces, net, u, v, points, smoothing)
    return net - StructuredSolver(problem).compute(StructuredSolver.Side(), problem.residual(net), {})[0]


def _posed(pieces, net, u, v, points, smoothing):
    system = make_system(pieces, u, v, points.T, jnp.ones_like(u), smoothing)
    return least_squares_problem(system, border(*net.shape[:2], corners_only=False), net)


def scipy_solve(knots, net, u, v, points, plate):
    """Design matrix row by row, the normal matrix, and a sparse Cholesky factorisation."""
    nu, nv, _ = net.shape
    along_u, along_v = (BSpline.design_matrix(x, t, 3) for x, t in zip((u, v), knots, strict=True))
    first_u, first_v = (a.indices.reshape(-1, 4) for a in (along_u, along_v))
    index = (first_u[:, :, None] * nv + first_v[:, None, :]).reshape(-1)
    data = (along_u.data.reshape(-1, 4, 1) * along_v.data.reshape(-1, 1, 4)).reshape(-1)
    starts = np.arange(len(u) + 1) * 16
    a = scipy.sparse.csr_matrix((data, index, starts), shape=(len(u), nu * nv))
    matrix = (a.T @ a).tocsc() if plate is None else (a.T @ a + plate).tocsc()
    held = border(nu, nv, corners_only=False).ravel()
    flat = net.reshape(-1, 3).copy()
    right = a.T @ points - matrix[:, held] @ flat[held]
    inner = matrix[~held][:, ~held].tocsc()
    solve = cholesky(inner) if cholesky else splu(inner).solve
    flat[~held] = solve(right[~held])
    return flat.reshape(net.shape)


def plate_of(knots, net):
    (u0, u1, u2), (v0, v1, v2) = (squares(k, n) for k, n in zip(knots, net.shape[:2], strict=True))
    parts = ((u2, v0, 1), (u1, v1, 2), (u0, v2, 1))
    sparse = [
        f * scipy.sparse.kron(scipy.sparse.csr_matrix(a), scipy.sparse.csr_matrix(b)) for a, b, f in parts
    ]
    total = (sparse[0] + sparse[1] + sparse[2]).tocsr()
    total.data[np.abs(total.data) < 1e-14 * np.abs(total.data).max()] = 0.0
    total.eliminate_zeros()
    return total


def rms(knots, net, u, v, points):
    surface = scipy.interpolate.NdBSpline(knots, np.asarray(net), 3)
    return np.sqrt(np.mean(np.sum((surface(np.stack([u, v], axis=-1)) - points) ** 2, axis=1)))


def main():
    parser = argparse.ArgumentParser(description="one least-squares solve with given parameters")
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--case", type=int, nargs="*", default=range(len(CASES)))
    options = parser.parse_args()
    other = "SciPy + CHOLMOD" if cholesky else "SciPy + splu"
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64, order (4, 4)")
    for count, nu, nv in (CASES[i] for i in options.case):
        u, v, points = cloud(count)
        knots = tuple(helpers.clamped_uniform(n, 4) for n in (nu, nv))
        x, y = np.meshgrid(*(np.convolve(k[1:-1], np.ones(3) / 3, "valid") for k in knots), indexing="ij")
        net = np.stack([x, y, np.zeros_like(x)], axis=-1)
        for smoothing in (0.0, SMOOTHING):
            plate = smoothing * plate_of(knots, net) if smoothing else None
            inputs = jax.device_put((make_pieces(net, *knots), net, u, v, points, np.asarray(smoothing)))
            memory = [held(f, inputs) for f in (through_optimistix, bare)]
            works = {
                "jaxfit, through optimistix": lambda i=inputs: jax.block_until_ready(through_optimistix(*i)),
                "jaxfit, bare": lambda i=inputs: jax.block_until_ready(bare(*i)),
                other: lambda a=(knots, net, u, v, points, plate): scipy_solve(*a),
            }
            memory.append(allocated(works[other]))
            title = f"{count} points, {nu}x{nv}, lambda {smoothing:g}"
            report(title, works, options.turns, inputs, knots, memory)


def held(function, inputs):
    """MiB of inputs, results and temporaries of a compiled function."""
    analysis = function.lower(*inputs).compile().memory_analysis()
    parts = (analysis.argument_size_in_bytes, analysis.output_size_in_bytes, analysis.temp_size_in_bytes)
    return sum(parts) / 2**20


def allocated(work):
    """MiB that NumPy and SciPy take at most (CHOLMOD's factors are not seen)."""
    tracemalloc.start()
    work()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 2**20


def report(title, works, turns, inputs, knots, memory):
    """Times in turns, distances from the points, and memory."""
    print(title)
    results = {name: work() for name, work in works.items()}
    times = {name: [] for name in works}
    for _ in range(turns):
        for name, work in works.items():
            begun = time.perf_counter()
            work()
            times[name].append(time.perf_counter() - begun)
    u, v, points = (np.asarray(x) for x in inputs[2:5])
    last = np.median(list(times.values())[-1])
    for (name, spent), most in zip(times.items(), memory, strict=True):
        low, middle, high = (1e3 * x for x in (min(spent), np.median(spent), max(spent)))
        error = rms(knots, results[name], u, v, points)
        ratio = 1e3 * last / middle
        print(
            f"  {name:<28}{middle:>9.1f} ms  [{low:.1f}, {high:.1f}]  {ratio:>6.2f} times as fast   "
            f"rms {error:.9e}   {most:>7.0f} MiB",
            flush=True,
        )


if __name__ == "__main__":
    main()
