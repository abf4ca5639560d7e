"""Fits of grids inside transformations: batches are loops, derivatives those of finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import wavy_grid

import jaxfit as jf

GRID = wavy_grid(8, 7)


@pytest.mark.parametrize("method", [jf.GeometricInterpolation(), jf.StandardInterpolation()])
def test_a_batch_of_grids_is_a_loop_over_them(method):
    def net(grid):
        return jf.interpolate(grid, method, tolerance=1e-9).surface.control_points

    noise = np.random.default_rng(5).normal(scale=5e-3, size=(32, *GRID.shape))
    grids = np.linspace(0.1, 3.0, 32)[:, None, None, None] * (GRID[None] + noise)
    nets = jax.jit(jax.vmap(net))(grids)
    for each, grid in zip(nets, grids, strict=True):
        assert np.abs(np.asarray(each) - np.asarray(net(grid))).max() < 1e-12


EVERY_CHOICE = jf.GeometricInterpolation(
    repositioning=jf.ConstantWeight(),
    acceleration=jf.Chebyshev(),
    freeze_after=3,
    keep_borders=True,
    symmetry=jf.Reflection(axis=1, normal=np.array([0.0, 1.0, 0.0])),
    local=True,
)


@pytest.mark.parametrize(
    ("method", "order"),
    [(jf.GeometricInterpolation(), (3, 5)), pytest.param(EVERY_CHOICE, (4, 4), marks=pytest.mark.slow)],
    ids=["usual", "every"],
)
def test_derivatives_are_those_of_finite_differences(method, order):
    rng = np.random.default_rng(3)
    grid = wavy_grid(7, 9) + rng.normal(scale=5e-3, size=(7, 9, 3))
    pull, way = rng.normal(size=(2, 7, 9, 3))

    def pulled(grid):
        net = jf.interpolate(grid, method, order=order, tolerance=1e-14).surface.control_points
        return jnp.sum(pull * net)

    value = jax.jit(jax.value_and_grad(pulled))
    slope = float(np.sum(np.asarray(value(grid)[1]) * way))
    h = 2e-6  # feet that leave the border make kinks
    near, far = (float(value(grid + k * h * way)[0] - value(grid - k * h * way)[0]) for k in (1, 2))
    difference = (8 * near - far) / (12 * h)
    assert abs(slope - difference) <= 1e-6 * abs(difference)
    if method is EVERY_CHOICE:  # outside `jit`; of the usual one in test_second_calls.py
        np.testing.assert_allclose(jax.grad(pulled)(grid), value(grid)[1], rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_the_implicit_derivative_holds_the_parameters():
    def net(grid):
        method = jf.GeometricInterpolation(adjoint=jf.ImplicitAdjoint())
        return jf.interpolate(grid, method, tolerance=1e-13).surface.control_points

    way = np.random.default_rng(1).normal(size=GRID.shape)
    change = jax.jit(lambda x, dx: jax.jvp(net, (x,), (dx,))[1])(GRID, way)
    fit = jf.interpolate(GRID, tolerance=1e-13)
    # The same parameters and knots, at which the data moves.
    moved = jf.BSplineSurface(change, fit.surface.knots_u, fit.surface.knots_v)
    np.testing.assert_allclose(np.asarray(moved(fit.u, fit.v)), way, atol=1e-9)
