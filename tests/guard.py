"""What a few public fits come to: stored in `guard.json`, so that no change of it goes unnoticed.

`python tests/guard.py` prints how the fits differ from what is stored, `python tests/guard.py --write` stores
them as they are now.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np
from helpers import clamped_uniform, count_compilations, wavy_cloud, wavy_grid

import jaxfit as jf

STORED = Path(__file__).with_name("guard.json")
POINTS = wavy_cloud(200)[0]
GRID = wavy_grid(8, 7)


def off_base():
    """A surface on the right border, whose inside is off by 2 % of its size."""
    x, y = (np.convolve(clamped_uniform(n, 4)[1:-1], np.ones(3) / 3, "valid") for n in (7, 6))
    net = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((7, 6))], axis=2)
    net[..., 2] = 0.1 * np.sin(3.0 * net[..., 0] + 0.5) * np.cos(2.5 * net[..., 1])
    net[1:-1, 1:-1] += 0.02 * np.random.default_rng(1).normal(size=(5, 4, 3))
    return jf.BSplineSurface(net, clamped_uniform(7, 4), clamped_uniform(6, 4))


def normals():
    """Of the height field at the points of the grid."""
    x, y = GRID[..., 0], GRID[..., 1]
    slope_x = 0.3 * np.cos(3.0 * x + 0.5) * np.cos(2.5 * y)
    slope_y = -0.25 * np.sin(3.0 * x + 0.5) * np.sin(2.5 * y)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=2)
    return normal / np.linalg.norm(normal, axis=2, keepdims=True)


def approximated(method, tolerance):
    return lambda: jf.approximate(POINTS, off_base(), method, tol_average=tolerance, max_steps=60)


FITS = {
    "approximate, geometric": approximated(jf.GeometricApproximation(), 1e-3),
    "approximate, paper": approximated(jf.GeometricApproximation.paper(), 1e-3),
    "approximate, standard": approximated(jf.StandardApproximation(smoothing=1e-6), 6e-4),
    "approximate, orthogonal": approximated(jf.OrthogonalDistance(), 3e-4),
    "interpolate, geometric": lambda: jf.interpolate(GRID, tolerance=1e-9),
    "interpolate, standard": lambda: jf.interpolate(GRID, jf.StandardInterpolation()),
    "interpolate, normals": lambda: jf.interpolate(GRID, normals=normals()),
}

# How much the measures of a fit may differ from those stored, relative and absolute. Of programs there may be
# fewer. Equations have their own test, `test_compile_size.py`.
TOLERANCES = {
    "iterations": (0.0, 1),
    "evaluations": (0.05, 0),
    "average error": (0.02, 1e-12),
    "maximum error": (0.05, 1e-12),
    "folds": (0.0, 0),
    "programs": (0.0, 0),
}


def measured():
    """The measures of every fit; programs are counted in this order, from none."""
    jax.clear_caches()
    return {name: measures(fit) for name, fit in FITS.items()}


def measures(function):
    with count_compilations() as compiled:
        fit = jax.block_until_ready(function())
    return {
        "iterations": int(fit.stats["num_steps"]),
        "evaluations": round(float(np.sum(fit.history.evaluations)), 3),
        "average error": float(f"{float(fit.average_error):.6g}"),
        "maximum error": float(f"{float(fit.maximum_error):.6g}"),
        "folds": int(fit.regularity.folds),
        "programs": compiled.count,
    }


def stored():
    return json.loads(STORED.read_text())


def differences(old, new):
    """A line for every measure of a fit that is out of its tolerance."""
    return [
        f"{fit}, {name}: stored {old[fit][name]:g}, now {new[fit][name]:g}"
        for fit in old
        for name, (relative, absolute) in TOLERANCES.items()
        if is_off(name, old[fit][name], new[fit][name], relative, absolute)
    ]


def is_off(name, old, new, relative, absolute):
    worse = new - old if name == "programs" else abs(new - old)
    return worse > relative * abs(old) + absolute


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    now = measured()
    if STORED.exists() and now.keys() == stored().keys():
        sys.stdout.write("".join(f"{line}\n" for line in differences(stored(), now)))
    if "--write" in sys.argv:
        STORED.write_text(json.dumps(now, indent=1) + "\n")
