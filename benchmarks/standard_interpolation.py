"""Standard interpolation of grids beside SciPy's two passes of `make_interp_spline`, in one run.

    python benchmarks/standard_interpolation.py [--turns 5] [--runs 20] [--data FOLDER]

Median times with the lowest and the highest, and the first call, which compiles. SciPy gets parameters and
knots for nothing; ours include them, the checks and the errors. They take turns, so that both meet the
same machine, several runs each, so that both find their data in the caches.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np
from scipy.interpolate import make_interp_spline

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers

import jaxfit as jf

SIZES = ((50, 200), (100, 400))


def tube(n, m):
    """A bent tube of varying radius, unevenly sampled."""
    angle = np.linspace(0, 2 * np.pi, m)[None, :] + 0.1 * np.sin(np.linspace(0, 7, m))[None, :]
    x = (np.linspace(0, 1, n) ** 1.2)[:, None]
    radius = 1 + 0.3 * np.sin(4 * x)
    parts = (5 * x, radius * np.cos(angle) + x**2, radius * np.sin(angle))
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def grid_of(n, m, folder):
    path = folder / f"fuselage_d150_{n}x{m}.npz"
    if path.is_file():
        return path.stem, np.load(path)["grid"].astype(float)
    return f"tube_{n}x{m}", tube(n, m)


def seconds(work):
    begun = time.perf_counter()
    result = work()
    return time.perf_counter() - begun, result


def row(name, first, times, note=""):
    low, middle, high = 1e3 * np.min(times), 1e3 * np.median(times), 1e3 * np.max(times)
    print(
        f"{name:<40}{middle:>9.2f} ms  [{low:.2f}, {high:.2f}]   first {1e3 * first:8.1f} ms  {note}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description="standard interpolation of grids")
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--runs", type=int, default=20, help="in each turn")
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64, order (4, 4)")
    for n, m in SIZES:
        name, grid = grid_of(n, m, options.data)
        method = jf.StandardInterpolation()

        def ours(grid=grid, method=method):
            return jax.block_until_ready(jf.interpolate(grid, method))

        first, fit = seconds(ours)
        u, v = np.asarray(fit.u[:, 0]), np.asarray(fit.v[0])
        knots_u, knots_v = np.asarray(fit.surface.knots_u), np.asarray(fit.surface.knots_v)

        def theirs(grid=grid, u=u, v=v, knots_u=knots_u, knots_v=knots_v):
            half = make_interp_spline(u, grid, 3, t=knots_u).c
            return make_interp_spline(v, half, 3, t=knots_v, axis=1).c

        their_first, net = seconds(theirs)
        turns = [work for _ in range(options.turns) for work in (ours, theirs)]
        spent = [[seconds(work)[0] for _ in range(options.runs)] for work in turns]
        times = np.array([np.ravel(spent[0::2]), np.ravel(spent[1::2])]).T
        apart = np.abs(np.asarray(fit.surface.control_points) - net.swapaxes(0, 1)).max()
        note = f"error {float(fit.maximum_error):.1e}, from SciPy {apart / helpers.diagonal(grid):.1e}"
        row(f"{name}, jaxfit", first, times[:, 0], note)
        row(f"{name}, SciPy", their_first, times[:, 1])
        print(f"{'':<40}{np.median(times[:, 0]) / np.median(times[:, 1]):>9.2f} times SciPy")


if __name__ == "__main__":
    main()
