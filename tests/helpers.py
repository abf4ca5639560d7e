"""Problems as data, and the few tools every test file shares."""

import os
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
_BESIDE = [folder / "shared" / "data" for folder in (CHECKOUT.parent, CHECKOUT)]
FOLDER = Path(os.environ.get("JAXFIT_DATA") or next(filter(Path.is_dir, _BESIDE), _BESIDE[0]))


def data(name):
    """The arrays of data set `name` as a dict; skips the test where the file is missing."""
    path = FOLDER / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"data set {name} is not in {FOLDER} (set JAXFIT_DATA to its folder)")
    with np.load(path) as arrays:
        return dict(arrays)


def eps():
    """Rounding unit of the session: 2.2e-16, or 1.2e-7 under --float32."""
    return float(jnp.finfo(jnp.result_type(float)).eps)


def diagonal(points):
    """Bounding-box diagonal of points (..., d)."""
    points = np.asarray(points)
    return float(np.linalg.norm(np.ptp(points.reshape(-1, points.shape[-1]), axis=0)))


def slow_except(cases, *quick):
    """All cases for `parametrize`, those not in `quick` marked slow."""
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]


# ------------------------------------------------------------------ problems


def clamped_uniform(count, order):
    """Clamped uniform knots on [0, 1], by NumPy, so that tests do not lean on what they test."""
    inner = np.linspace(0.0, 1.0, count - order + 2)
    return np.concatenate([np.zeros(order - 1), inner, np.ones(order - 1)])


def random_clamped_knots(rng, count, order, repeats=0):
    """Clamped knots on [0, 1] for `count` control points; `repeats` interior knots coincide.

    The repeats pile up on one interior knot, at most `order` - 1 deep, before the next.
    """
    inner = np.sort(rng.uniform(0.05, 0.95, count - order))
    for k in range(min(repeats, len(inner) - 1)):
        if (k + 1) % max(order - 1, 1):
            inner[k + 1] = inner[k]
    return np.concatenate([np.zeros(order), inner, np.ones(order)])


def wavy_net(nu, nv, height=0.1):
    """Control points (nu, nv, 3) of a gently wavy height field over the unit square."""
    x, y = np.meshgrid(np.linspace(0, 1, nu), np.linspace(0, 1, nv), indexing="ij")
    z = height * (np.sin(5.0 * x + 1.0) * np.cos(4.0 * y) + 0.5 * x * y)
    return np.stack([x, y, z], axis=-1)


def wavy_surface(nu=7, nv=6, order=(4, 4), dtype=None):
    """`wavy_net` on clamped uniform knots, as a surface."""
    from jaxfit._splines import BSplineSurface

    dtype = jnp.result_type(float) if dtype is None else dtype
    return BSplineSurface(
        jnp.asarray(wavy_net(nu, nv), dtype),
        jnp.asarray(clamped_uniform(nu, order[0]), dtype),
        jnp.asarray(clamped_uniform(nv, order[1]), dtype),
    )


def random_surface(order=(4, 3), d=3, repeats=2, seed=0, extra=5):
    """Random control points on random clamped knots, `extra` interior knots per direction."""
    from jaxfit._splines import BSplineSurface

    rng = np.random.default_rng(seed)
    knots = [random_clamped_knots(rng, k + extra, k, repeats) for k in order]
    return BSplineSurface(rng.normal(size=(order[0] + extra, order[1] + extra, d)), *knots)


def parameters_on_knots(surface, count=40, seed=1):
    """`count` pairs (u, v): on every knot and both ends, and for the rest at random."""
    rng = np.random.default_rng(seed)
    dtype = jnp.result_type(float)
    on = [np.unique(k) for k in (surface.knots_u, surface.knots_v)]
    pairs = rng.random((2, count))
    for x, knots in zip(pairs, on, strict=True):
        x[: count // 2] = np.resize(knots, count // 2)
    return pairs.astype(dtype)


def wavy_grid(n, m, height=0.1):
    """Data points (n, m, 3) on a wavy height field that no small net reproduces."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij")
    z = height * np.sin(3.0 * x + 0.5) * np.cos(2.5 * y)
    return np.stack([x, y, z], axis=-1)


def wavy_cloud(count, seed=0, height=0.1):
    """`wavy_grid`'s height field at `count` random places, and its four border polylines."""
    x, y = np.random.default_rng(seed).uniform(size=(2, count))
    z = height * np.sin(3.0 * x + 0.5) * np.cos(2.5 * y)
    return np.stack([x, y, z], axis=-1), grid_edges(wavy_grid(33, 33, height))


def noisy_sheet(count, net):
    """A rough height field at `count` random places, and a flat surface to start from. Its border, which is
    held, is off the points: steps from it are damped, so that they hardly depend on rounding.
    """
    import jaxfit as jf

    rng = np.random.default_rng(0)
    points = rng.random((count, 3))
    points[:, 2] = 0.2 * np.sin(5 * points[:, 0]) * np.cos(4 * points[:, 1]) + 1e-3 * rng.normal(size=count)
    x, y = np.meshgrid(*(np.linspace(0, 1, n) for n in net), indexing="ij")
    knots = [clamped_uniform(n, 4) for n in net]
    return points, jf.BSplineSurface(np.stack([x, y, 0 * x], axis=-1), *knots)


def grid_edges(grid):
    """The four edges of a grid as the arguments of a Boundary."""
    return {"v0": grid[:, 0], "v1": grid[:, -1], "u0": grid[0], "u1": grid[-1]}


def mean_distance(surface, points, samples=400):
    """Mean distance of points from many samples of a surface, by SciPy: nothing compiles for a new net."""
    from scipy.interpolate import BSpline
    from scipy.spatial import cKDTree

    net, at = np.asarray(surface.control_points, float), np.linspace(0, 1, samples)
    for knots, order in ((surface.knots_u, surface.order[0]), (surface.knots_v, surface.order[1])):
        net = np.swapaxes(BSpline(np.asarray(knots, float), net, order - 1)(at), 0, 1)
    return float(cKDTree(net.reshape(-1, net.shape[-1])).query(points)[0].mean())


def folds(surface, samples=200):
    """Neighbours on a grid of parameters whose normals are more than 90 degrees apart, by SciPy."""
    from scipy.interpolate import BSpline

    at, steps = np.linspace(0, 1, samples), []
    for along in (0, 1):
        net = np.asarray(surface.control_points, float)
        for axis, (knots, order) in enumerate(
            zip((surface.knots_u, surface.knots_v), surface.order, strict=True)
        ):
            values = BSpline(np.asarray(knots, float), net, order - 1)(at, int(axis == along))
            net = np.swapaxes(values, 0, 1)
        steps.append(net)
    normals = np.cross(*steps)
    pairs = (normals[1:], normals[:-1]), (normals[:, 1:], normals[:, :-1])
    return sum(int(np.sum(np.sum(a * b, axis=2) < 0)) for a, b in pairs)


# ---------------------------------------------------------------- compile counts

_compiled = []  # names of programs


def _listen(event, duration, fun_name="", **kwargs):
    if event == "/jax/core/compile/backend_compile_duration":
        _compiled.append(fun_name)


jax.monitoring.register_event_duration_secs_listener(_listen)


@contextmanager
def count_compilations():
    """`with count_compilations() as compiled: ...` and then `compiled.count`, or `compiled.names`."""
    result, before = SimpleNamespace(count=0, names=[]), len(_compiled)
    yield result
    result.names = _compiled[before:]
    result.count = len(result.names)
