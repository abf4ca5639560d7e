"""Chord-length and centripetal parameters: values, invariance, degenerate rows, derivatives."""

from itertools import pairwise

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit._parameters import Centripetal, ChordLength, curve_parameters, grid_parameters

METHODS = [ChordLength(), Centripetal()]


def naive(points, exponent):
    steps = np.array([np.linalg.norm(b - a) ** exponent for a, b in pairwise(points)])
    return np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()


def sphere(n=7, m=6):
    """Half a sphere with a pole at either end of the first index."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2, m), indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


@pytest.mark.float32_too
@pytest.mark.parametrize("method", METHODS, ids=["chord", "centripetal"])
def test_a_curve_equals_the_formula(method):
    points = np.random.default_rng(0).normal(size=(9, 3))
    expected = naive(points, method.exponent)
    np.testing.assert_allclose(curve_parameters(points, method), expected, atol=8 * helpers.eps())


@pytest.mark.float32_too
@pytest.mark.parametrize("method", METHODS, ids=["chord", "centripetal"])
def test_a_grid_equals_the_formula_row_by_row_and_averaged(method):
    grid = helpers.wavy_grid(7, 6) + 0.02 * np.random.default_rng(1).normal(size=(7, 6, 3))
    u, v, rows_u, rows_v = grid_parameters(grid, method)
    expected_u = np.stack([naive(grid[:, j], method.exponent) for j in range(6)], axis=1)
    expected_v = np.stack([naive(grid[i], method.exponent) for i in range(7)])
    atol = 20 * helpers.eps()
    np.testing.assert_allclose(rows_u, expected_u, atol=atol)
    np.testing.assert_allclose(rows_v, expected_v, atol=atol)
    np.testing.assert_allclose(u, expected_u.mean(axis=1), atol=atol)
    np.testing.assert_allclose(v, expected_v.mean(axis=0), atol=atol)
    assert u[0] == v[0] == 0
    assert u[-1] == v[-1] == 1


@pytest.mark.float32_too
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_units_do_not_matter(scale):
    grid = helpers.wavy_grid(7, 6)
    for ours, reference in zip(grid_parameters(grid * scale), grid_parameters(grid), strict=True):
        np.testing.assert_allclose(ours, reference, atol=20 * helpers.eps())


def test_coordinates_in_the_millions_keep_their_parameters():
    grid = helpers.wavy_grid(7, 6)
    moved = grid_parameters(grid + np.array([5.1e5, 5.4e6, 0.0]))
    np.testing.assert_allclose(moved.u, grid_parameters(grid).u, atol=1e-8)


@pytest.mark.float32_too
def test_poles_are_left_out_of_the_average():
    grid = sphere()
    u, v, rows_u, rows_v = grid_parameters(grid)
    np.testing.assert_allclose(v, np.linspace(0, 1, 6), atol=20 * helpers.eps())
    np.testing.assert_allclose(rows_v[0], v, atol=20 * helpers.eps())  # the pole's own row
    np.testing.assert_allclose(u, np.linspace(0, 1, 7), atol=20 * helpers.eps())
    assert np.isfinite(rows_u).all()


@pytest.mark.float32_too
def test_equal_neighbours_get_a_small_step():
    x = np.array([0.0, 1.0, 1.0, 2.0, 4.0])
    u = np.asarray(curve_parameters(np.stack([x, 0 * x], axis=1)))
    assert (np.diff(u) > 0).all()
    np.testing.assert_allclose(u, x / 4, atol=helpers.eps() ** (1 / 3))
    grid = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)
    assert (np.diff(grid_parameters(grid).u) > 0).all()
    assert (np.diff(grid_parameters(grid).v) > 0).all()


@pytest.mark.parametrize(
    ("points", "sentence"),
    [
        (np.ones((4, 3)), "must not all be equal"),
        (np.ones((1, 3)), "at least 2 points"),
        (np.full((4, 3), np.nan), "must be finite"),
    ],
)
def test_hopeless_curves_are_refused(points, sentence):
    with pytest.raises(ValueError, match=sentence):
        curve_parameters(points)


@pytest.mark.parametrize(
    ("grid", "sentence"),
    [
        (np.ones((4, 5, 3)), "first index"),
        (np.broadcast_to(np.linspace(0, 1, 4)[:, None, None], (4, 5, 3)), "second index"),
        (np.ones((1, 5, 3)), "at least 2 x 2"),
        (np.ones((4, 3)), "must have 3 dimensions"),
    ],
)
def test_hopeless_grids_are_refused(grid, sentence):
    with pytest.raises(ValueError, match=sentence):
        grid_parameters(grid)


def test_inside_jit_the_same_values_and_never_nan():
    grid = jnp.asarray(helpers.wavy_grid(7, 6))
    traced = jax.jit(grid_parameters)
    for ours, reference in zip(traced(grid), grid_parameters(grid), strict=True):
        np.testing.assert_allclose(ours, reference, atol=1e-15)
    np.testing.assert_allclose(traced(0 * grid).u, np.linspace(0, 1, 7), atol=1e-15)


@pytest.mark.parametrize("method", METHODS, ids=["chord", "centripetal"])
def test_derivatives_are_finite_at_poles_and_equal_differences_elsewhere(method):
    def weighted(grid):
        out = grid_parameters(grid, method)
        return sum(jnp.sum(jnp.sin(7.0 * x)) for x in out)

    gradient = jax.jit(jax.grad(weighted))
    assert np.isfinite(gradient(jnp.asarray(sphere()))).all()
    grid = jnp.asarray(helpers.wavy_grid(7, 6))
    direction = jnp.asarray(np.random.default_rng(2).normal(size=grid.shape))
    h = 1e-6
    difference = (weighted(grid + h * direction) - weighted(grid - h * direction)) / (2 * h)
    np.testing.assert_allclose(jnp.sum(gradient(grid) * direction), difference, rtol=1e-6)


@pytest.mark.parametrize("name", ["hood_beetle_10x10", "fran_face_45x49", "jacksboro_dem"])
def test_scanned_grids_get_increasing_parameters(name):
    u, v, _, _ = grid_parameters(helpers.data(name)["grid"])
    assert (np.diff(u) > 0).all()
    assert (np.diff(v) > 0).all()


def test_a_closed_fuselage_gets_increasing_parameters():
    grid = helpers.data("fuselage_d150_100x400")["grid"]
    assert (np.diff(grid_parameters(grid).u) > 0).all()
