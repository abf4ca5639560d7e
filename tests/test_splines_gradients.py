"""Gradients are finite everywhere and equal finite differences."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit._splines import BSplineCurve, BSplineSurface

ORDER = (4, 3)


@jax.jit
def energy(surface, u, v):
    """A number that every input moves."""
    return sum(jnp.sum(value**2) for value in surface.derivatives(u, v, 2).values())


gradient = jax.jit(jax.grad(energy, argnums=(0, 1, 2)))


def smooth_surface():
    """Simple knots, none of them close: finite differences then have digits."""
    rng = np.random.default_rng(5)
    knots = [helpers.clamped_uniform(k + 5, k) for k in ORDER]
    for each, order in zip(knots, ORDER, strict=True):
        each[order:-order] += rng.uniform(-0.05, 0.05, 5)
    return BSplineSurface(rng.normal(size=(9, 8, 3)), *knots)


def assert_slope(function, x, gradient, step=1e-5):
    """The gradient equals central differences along some random directions."""
    for direction in np.random.default_rng(0).normal(size=(3, *x.shape)):
        ends = [float(function(x + sign * step * direction)) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        actual = np.sum(np.asarray(gradient) * direction)
        assert abs(actual - expected) <= 1e-6 * np.linalg.norm(gradient)


def test_gradients_equal_finite_differences():
    surface = smooth_surface()
    net, knots_u, knots_v = (np.asarray(x) for x in jax.tree.leaves(surface))
    u, v = np.random.default_rng(0).uniform(0.02, 0.98, (2, 12))
    slopes, slope_u, slope_v = gradient(surface, u, v)
    assert_slope(lambda u: energy(surface, u, v), u, slope_u)
    assert_slope(lambda v: energy(surface, u, v), v, slope_v)
    assert_slope(lambda net: energy(BSplineSurface(net, knots_u, knots_v), u, v), net, slopes.control_points)

    def with_inner_knots(inner):
        knots = np.concatenate([knots_u[:4], inner, knots_u[-4:]])
        return energy(BSplineSurface(net, knots, knots_v), u, v)

    assert_slope(with_inner_knots, knots_u[4:-4], slopes.knots_u[4:-4])


@pytest.mark.float32_too
@pytest.mark.parametrize("repeats", [0, 3])
def test_gradients_are_finite_on_knots_on_ends_and_outside(repeats):
    surface = helpers.random_surface(ORDER, repeats=repeats)
    u = np.resize(np.append(np.unique(surface.knots_u), [-0.5, 1.5]), 12)
    v = np.resize(np.unique(surface.knots_v)[::-1], 12)
    for leaf in jax.tree.leaves(gradient(surface, u, v)):
        assert np.isfinite(leaf).all()


def test_the_gradient_by_the_parameter_is_the_derivative():
    # On the ends as well, where a plain clip would halve it; outside the point does not move.
    curve = BSplineCurve(np.random.default_rng(0).normal(size=(7, 2)), helpers.clamped_uniform(7, 4))
    u = np.array([0.0, 0.25, 0.6, 1.0])
    tangents = jax.jit(jax.vmap(jax.jacfwd(curve)))(u)
    np.testing.assert_allclose(tangents, curve.derivative(u), atol=1e-12)
    outside = np.array([-0.5, 1.5, 2.0, 3.0])
    assert not jax.jit(jax.vmap(jax.jacfwd(curve)))(outside).any()
    assert curve.derivative(outside).all()


def test_batches_of_surfaces():
    surface = smooth_surface()
    u, v = np.random.default_rng(0).random((2, 5))
    nets = jnp.stack([surface.control_points, 2 * surface.control_points])

    def build(net):
        return BSplineSurface(net, surface.knots_u, surface.knots_v)

    batch = jax.vmap(build)(nets)
    assert batch.shape == (9, 8)
    assert batch.order == ORDER
    points = jax.vmap(lambda each: each(u, v))(batch)
    np.testing.assert_allclose(points[1], 2 * surface(u, v), atol=1e-13)


def test_gradients_through_blocks():
    surface = smooth_surface()
    u, v = np.random.default_rng(0).random((2, 9000))
    net = surface.control_points

    def total(net):
        return jnp.sum(BSplineSurface(net, surface.knots_u, surface.knots_v)(u, v))

    # By linearity the entries sum to the number of points, coordinate by coordinate.
    slope = jax.jit(jax.grad(total))(net)
    np.testing.assert_allclose(jnp.sum(slope, axis=(0, 1)), 9000, rtol=1e-12)
    basis = np.asarray(jax.jit(lambda net: total(net))(jnp.zeros_like(net).at[3, 4, 0].set(1.0)))
    np.testing.assert_allclose(slope[3, 4, 0], basis, rtol=1e-11)
