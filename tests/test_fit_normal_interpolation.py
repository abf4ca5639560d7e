"""Grids with normals: points and tangent planes are met, and what cannot be met is said."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import eps

import jaxfit as jf


def sphere(n, m):
    """Points of the unit sphere, which are their own normals."""
    a, b = np.linspace(-0.9, 0.9, n)[:, None], np.linspace(-1.2, 1.2, m)[None, :]
    return np.stack(np.broadcast_arrays(np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)), axis=-1)


GRID = sphere(7, 9)


def tilted(scale=0.2):
    normals = GRID + np.random.default_rng(0).normal(scale=scale, size=GRID.shape)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def angle(surface, u, v, normals):
    there = np.asarray(surface.normal(np.ravel(u), np.ravel(v))).reshape(normals.shape)
    return np.arccos(np.clip(np.abs(np.sum(there * normals, axis=-1)), 0, 1)).max()


@pytest.mark.float32_too
def test_points_and_normals_are_met():
    normals = tilted()
    fit = jf.interpolate(GRID, normals=normals)
    assert bool(fit.converged), fit.message
    assert fit.surface.control_points.shape == (14, 18, 3)
    there = np.asarray(fit.surface(fit.u, fit.v))
    assert np.abs(there - GRID).max() <= 50 * eps()
    assert angle(fit.surface, fit.u, fit.v, normals) <= 100 * np.sqrt(eps())
    assert float(fit.stats["maximum_normal_error"]) <= 1e4 * eps()


def test_true_normals_bring_the_surface_closer():
    where = np.linspace(0, 1, 41)

    def farthest(fit):
        return np.abs(np.linalg.norm(np.asarray(fit.surface.grid(where, where)), axis=-1) - 1).max()

    with_normals = jf.interpolate(GRID, jf.NormalInterpolation(), normals=GRID)
    assert farthest(with_normals) < 0.1 * farthest(jf.interpolate(GRID, jf.StandardInterpolation()))


def test_normals_of_a_spline_through_the_data_keep_its_derivatives():
    plain = jf.interpolate(GRID, jf.StandardInterpolation())
    u, v = (np.ravel(x) for x in (plain.u, plain.v))
    normals = np.asarray(plain.surface.normal(u, v)).reshape(GRID.shape)
    fit = jf.interpolate(GRID, normals=normals)
    for du, dv in ((1, 0), (0, 1), (1, 1)):
        expected = np.asarray(plain.surface.derivative(u, v, du, dv))
        np.testing.assert_allclose(np.asarray(fit.surface.derivative(u, v, du, dv)), expected, atol=1e-10)


def test_all_normals_may_point_to_the_other_side():
    fit = jf.interpolate(GRID, normals=-tilted())
    assert bool(fit.converged), fit.message


@pytest.mark.parametrize("case", ["one flipped", "one in the surface"])
def test_normals_that_would_fold_the_surface_are_reported(case):
    normals = tilted()
    along = GRID[3, 4] - GRID[3, 3]
    normals[3, 3] = -normals[3, 3] if case == "one flipped" else along / np.linalg.norm(along)
    fit = jf.interpolate(GRID, normals=normals)
    assert not bool(fit.converged)
    assert fit.result == jf.RESULTS.normals_missed
    assert np.isfinite(np.asarray(fit.surface.control_points)).all()
    assert float(fit.stats["normal_errors"][3, 3]) > 1.0
    assert np.delete(np.asarray(fit.stats["normal_errors"]), 3 * 9 + 3).max() < 1e-9
    with pytest.raises(RuntimeError, match="fold"):
        jf.interpolate(GRID, normals=normals, throw=True)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"normals": 2 * GRID}, "must be unit vectors"),
        ({"normals": GRID[:3]}, "one vector in space for each point"),
        ({"normals": np.where(GRID[2, 2] == GRID, np.nan, GRID)}, "normals must be finite"),
        ({"normals": GRID, "order": (2, 4)}, "order must be at least 3"),
        ({"normals": GRID, "method": jf.StandardInterpolation()}, "cannot be met by StandardInterpolation"),
        ({"method": jf.NormalInterpolation()}, "normals must be given"),
    ],
)
def test_what_does_not_fit_gets_a_sentence(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        jf.interpolate(GRID, **options)


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences():
    rng = np.random.default_rng(3)
    pull = rng.normal(size=(14, 18, 3))

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def value(grid, normals):
        normals = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
        return jnp.sum(pull * jf.interpolate(grid, normals=normals, order=(3, 5)).surface.control_points)

    _, slopes = value(GRID, GRID)
    for which, slope in enumerate(slopes):
        way = rng.normal(size=GRID.shape)
        ends = [[GRID, GRID], [GRID, GRID]]
        for end, h in zip(ends, (1e-5, -1e-5), strict=True):
            end[which] = GRID + h * way
        difference = float(value(*ends[0])[0] - value(*ends[1])[0]) / 2e-5
        assert abs(float(np.sum(np.asarray(slope) * way)) - difference) <= 1e-6 * abs(difference)


@pytest.mark.slow
def test_a_batch_is_its_grids():
    both = np.stack([GRID, 2 * GRID[::-1]])
    normals = np.stack([tilted(), -tilted()[::-1]])
    nets = jax.vmap(lambda q, n: jf.interpolate(q, normals=n).surface.control_points)(both, normals)
    for net, grid, normal in zip(nets, both, normals, strict=True):
        alone = jf.interpolate(grid, normals=normal).surface.control_points
        np.testing.assert_allclose(np.asarray(net), np.asarray(alone), atol=1e-12)
