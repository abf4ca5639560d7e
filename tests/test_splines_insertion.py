"""Refining and splitting change the description of a surface and not the surface."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline, insert
from scipy.special import comb

from jaxfit._splines import BSplineCurve, BSplineSurface, insertion_matrix


@pytest.mark.float32_too
@given(st.integers(0, 1000))
def test_inserting_many_knots_leaves_the_surface_unchanged(seed):
    rng = np.random.default_rng(seed)
    surface = helpers.random_surface(seed=seed)
    new_u, new_v = rng.random(7), np.full(2, 0.97)
    # Existing knots too, and one of them twice over the others' gaps.
    new_u[3], new_u[4] = new_u[2], np.asarray(surface.knots_u)[-5]
    finer = surface.insert_knots(new_u, new_v)
    assert finer.shape == (16, 10)
    assert finer.order == surface.order
    us, vs = helpers.parameters_on_knots(surface)
    scale = np.abs(surface.control_points).max()
    change = np.abs(finer.grid(us, vs) - surface.grid(us, vs)).max()
    assert change <= 40 * helpers.eps() * scale


@pytest.mark.parametrize("order", [2, 3, 8])
def test_insertion_equals_scipy_one_knot_at_a_time(order):
    rng = np.random.default_rng(order)
    knots = helpers.random_clamped_knots(rng, order + 4, order)
    curve = BSplineCurve(rng.normal(size=(order + 4, 2)), knots)
    spline = BSpline(knots, np.asarray(curve.control_points), order - 1)
    new = rng.uniform(0.05, 0.95, 5)
    for x in new:
        spline = insert(x, spline)
    finer = curve.insert_knots(new)
    np.testing.assert_allclose(finer.knots, spline.t)
    np.testing.assert_allclose(finer.control_points, spline.c[: finer.control_points.shape[0]], atol=1e-12)


@pytest.mark.float32_too
@given(st.integers(0, 1000), st.sampled_from([2, 5]))
def test_rows_of_the_insertion_matrix_are_convex_combinations(seed, order):
    rng = np.random.default_rng(seed)
    dtype = jnp.result_type(float)
    knots = jnp.asarray(helpers.random_clamped_knots(rng, order + 4, order, 2), dtype)
    new = jnp.asarray(rng.random(6), dtype)
    matrix = np.asarray(insertion_matrix(knots, order, new))
    assert matrix.shape == (order + 10, order + 4)
    assert matrix.min() >= -helpers.eps()
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=20 * helpers.eps())
    points = rng.normal(size=(order + 4, 1))
    moved = BSplineCurve(points, knots).insert_knots(new).control_points
    np.testing.assert_allclose(moved, matrix @ points, atol=40 * helpers.eps())


def test_inserting_nothing_changes_nothing():
    surface = helpers.random_surface()
    same = surface.insert_knots()
    np.testing.assert_allclose(same.control_points, surface.control_points, atol=1e-15)
    np.testing.assert_array_equal(same.knots_v, surface.knots_v)


def test_insertion_under_jit_vmap_and_grad():
    surface = helpers.random_surface()
    new = jnp.asarray([[0.2, 0.4], [0.9, 0.1]])

    def refined(new):
        return surface.insert_knots(u=new)

    batch = jax.jit(jax.vmap(refined))(new)
    np.testing.assert_allclose(batch.control_points[1], refined(new[1]).control_points, atol=1e-14)
    curve = surface.iso_v(0.4)

    @jax.jit
    @jax.grad
    def slope(new):
        return jnp.sum(curve.insert_knots(new)(0.3))

    # The curve does not depend on where the knots are inserted.
    np.testing.assert_allclose(slope(new[0]), 0.0, atol=1e-12)


@pytest.mark.float32_too
@pytest.mark.parametrize("order", [(4, 3), (2, 7)])
def test_split_gives_the_bezier_points_of_every_span(order):
    surface = helpers.random_surface(order, repeats=3)
    patches, breaks_u, breaks_v = surface.split()
    np.testing.assert_array_equal(breaks_u, np.unique(surface.knots_u))
    np.testing.assert_array_equal(breaks_v, np.unique(surface.knots_v))
    assert patches.shape == (breaks_u.size - 1, breaks_v.size - 1, *order, 3)
    x = np.array([0.0, 0.3, 0.9])
    # Bernstein polynomials by their definition.
    basis = [np.stack([comb(k - 1, a) * x**a * (1 - x) ** (k - 1 - a) for a in range(k)]) for k in order]
    on_patches = np.einsum("stabd,ax,by->sxtyd", patches, *basis)
    us, vs = ((b[:-1, None] + np.diff(b)[:, None] * x).ravel() for b in map(np.asarray, surface.split()[1:]))
    expected = np.asarray(surface.grid(us, vs)).reshape(on_patches.shape)
    scale = np.abs(surface.control_points).max()
    assert np.abs(on_patches - expected).max() <= 100 * helpers.eps() * scale


def test_the_curve_splits_like_the_surface():
    curve = helpers.random_surface().iso_v(0.4)
    pieces, breakpoints = curve.split()
    assert pieces.shape == (breakpoints.size - 1, 4, 3)
    np.testing.assert_allclose(curve(breakpoints[:-1]), pieces[:, 0], atol=1e-14)
    halves = 0.5 * (breakpoints[:-1] + breakpoints[1:])
    weights = np.array([1, 3, 3, 1]) / 8
    np.testing.assert_allclose(curve(halves), np.einsum("sad,a->sd", pieces, weights), atol=1e-14)


def test_control_points_may_be_traced_when_splitting_and_knots_not():
    surface = helpers.random_surface()

    def corner(net, knots_u):
        return BSplineSurface(net, knots_u, surface.knots_v).split().control_points[0, 0, 0, 0]

    traced = jax.jit(lambda net: corner(net, surface.knots_u))(surface.control_points)
    np.testing.assert_allclose(traced, surface(0.0, 0.0), atol=1e-15)
    with pytest.raises(TypeError, match="knots_u must be concrete to split"):
        jax.jit(corner)(surface.control_points, surface.knots_u)


def test_bad_insertions_say_what_to_do():
    surface = helpers.random_surface(repeats=0)
    with pytest.raises(ValueError, match=r"u must lie in the domain \[0, 1\], but reaches"):
        surface.insert_knots(u=np.array([0.5, 1.5]))
    with pytest.raises(ValueError, match="knots_v must repeat no interior knot more than 3 times"):
        surface.insert_knots(v=np.full(4, 0.5))
    with pytest.raises(ValueError, match="new_knots must lie in the domain"):
        surface.iso_u(0.5).insert_knots([-0.1])
