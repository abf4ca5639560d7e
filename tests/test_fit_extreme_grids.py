"""Grids whose sections lie centimetres and tens of metres apart: whatever the linear system interpolates."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import data, diagonal, eps, slow_except

import jaxfit as jf

GEOMETRIC = jf.GeometricInterpolation()
STALLING = jf.GeometricInterpolation(solve_stalled=False)
METHODS = {
    "default": GEOMETRIC,
    "Chebyshev": jf.GeometricInterpolation(acceleration=jf.Chebyshev()),
}


def rings(x, radius, drop, around):
    """Circles at the stations x, closed."""
    angle = np.linspace(0, 2 * np.pi, around)[:, None]
    grid = np.stack(np.broadcast_arrays(x, radius * np.sin(angle), radius * np.cos(angle) - drop), axis=-1)
    grid[-1] = grid[0]
    return grid


def fuselage(around=160):
    """30 sections, the first six 2 cm apart, all others 10 m; the nose is a ring of 2 cm."""
    x = np.cumsum(np.r_[0, np.full(5, 0.02), np.full(24, 10.0)])
    to_nose, to_tail = np.clip(1 - x / 8, 0, 1), np.clip(x / x[-1] - 0.7, 0, 1) / 0.3
    radius = 0.02 + 2 * np.sqrt(1 - to_nose**2) * (1 - 0.8 * to_tail**2)
    return rings(x, radius, 0.4 * to_nose**2, around)


def drooping_nose():
    """Sections at equal distances, the first ones small and low: closest points slide along their rings."""
    x = np.linspace(0, 20, 10)
    to_nose = np.clip(1 - x / 3, 0, 1)
    return rings(x, 1 - 0.95 * to_nose, to_nose**2, 24)


@pytest.mark.float32_too
@pytest.mark.parametrize("name", slow_except(METHODS, "default"))
def test_an_extreme_grid_is_met_in_at_most_200_iterations(name):
    grid = fuselage()
    seen = []
    fit = jf.interpolate(grid, METHODS[name], progress=lambda *report: seen.append(report))
    assert bool(fit.converged), fit.message
    assert bool(fit.stats["solved"])
    assert float(fit.maximum_error) <= (1e-14 if eps() < 1e-10 else 2e-6)
    assert int(fit.stats["num_steps"]) <= 200
    assert len(fit.history.maximum) == int(fit.stats["num_steps"]) + 1
    assert float(fit.history.maximum[-1]) <= float(fit.maximum_error)
    assert seen[-1][::3] == (int(fit.stats["num_steps"]), float(fit.history.maximum[-1]))
    there = np.asarray(fit.surface(fit.u, fit.v))
    assert np.linalg.norm(there - grid, axis=-1).max() <= 50 * eps() * diagonal(grid)
    standard = jf.interpolate(grid, jf.StandardInterpolation()).surface
    assert np.abs(np.asarray(fit.surface.control_points - standard.control_points)).max() <= 1e3 * eps()


@pytest.mark.slow
def test_without_the_linear_system_it_says_that_it_has_stalled():
    grid = fuselage(41)
    for fit in (jf.interpolate(grid, STALLING), jax.jit(jf.interpolate)(grid)):
        assert fit.result == jf.RESULTS.stalled
        assert not bool(fit.stats["solved"])
        assert float(fit.maximum_error) > 1e-6
        there = np.asarray(fit.surface(fit.u, fit.v))
        np.testing.assert_allclose(
            np.linalg.norm(there - grid, axis=-1) / diagonal(grid), fit.errors, atol=1e-12
        )
    assert bool(jf.interpolate(grid).stats["solved"])


def test_the_linear_system_takes_no_iteration_that_is_not_allowed():
    grid = fuselage(41)
    needed = int(jf.interpolate(grid).stats["num_steps"])
    fit = jf.interpolate(grid, max_steps=needed - 1)
    assert not bool(fit.stats["solved"])
    assert not bool(fit.converged)
    assert bool(jf.interpolate(grid, max_steps=needed).converged)


def test_errors_at_rounding_level_are_left_to_the_iteration():
    fit = jf.interpolate(drooping_nose(), tolerance=0.0)
    assert fit.result == jf.RESULTS.stalled
    assert float(fit.maximum_error) <= 20 * eps()
    assert not bool(fit.stats["solved"])


def test_a_grid_in_order_gets_a_surface_without_folds():
    # Points of a column lie so close together that closest points slide past several of them.
    x, y = np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 1, 60), indexing="ij")
    grid = np.stack([x, y, 0.8 * np.sin(4 * x) * np.cos(5 * y)], axis=-1)
    as_found = jf.interpolate(grid, jf.GeometricInterpolation(solve_stalled=False, stall_gain=0.75))
    fit = jf.interpolate(grid)
    assert as_found.folds > 100
    assert as_found.message.endswith("try StandardInterpolation().")
    assert fit.folds == 0
    assert bool(fit.converged), fit.message
    assert bool(fit.stats["solved"])
    assert int(fit.stats["num_steps"]) == int(as_found.stats["num_steps"]) + 1


def test_a_symmetric_fit_stays_symmetric():
    grid = fuselage(41)
    reflection = jf.Reflection(normal=np.eye(3)[1])
    fit = jf.interpolate(grid, jf.GeometricInterpolation(symmetry=reflection))
    assert bool(fit.converged), fit.message
    assert bool(fit.stats["solved"])
    mirror = reflection.located(grid)
    assert float(mirror.asymmetry(fit.surface.control_points)) <= 1e-13 * diagonal(grid)


@pytest.mark.float32_too
def test_feet_that_keep_their_order_need_no_linear_system():
    grid = drooping_nose()
    fit = jf.interpolate(grid, STALLING)
    assert bool(fit.converged), fit.message
    assert int(fit.stats["num_steps"]) <= 200
    parameters = jf.grid_parameters(grid)
    for feet, own in ((fit.u, parameters.u), (np.asarray(fit.v).T, parameters.v)):
        middles = 0.5 * (own[1:] + own[:-1])[:, None]
        assert (np.asarray(feet)[:-1] <= middles + 1e3 * eps()).all()
        assert (np.asarray(feet)[1:] >= middles - 1e3 * eps()).all()


@pytest.mark.slow
def test_derivatives_follow_feet_that_stay():
    # A grid that is symmetric to the last bit has feet on kinks.
    rng = np.random.default_rng(5)
    grid = drooping_nose() + rng.normal(scale=1e-2, size=(24, 10, 3))
    direction, cotangent = rng.normal(size=(2, *grid.shape))

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def value(grid):
        fit = jf.interpolate(grid, tolerance=1e-14)
        return jnp.sum(cotangent * fit.surface.control_points), fit.converged

    step = 1e-6
    (high, met), (low, _) = (value(grid + s * direction)[0] for s in (step, -step))
    assert bool(met)
    slope = np.sum(np.asarray(value(grid)[1]) * direction)
    np.testing.assert_allclose(slope, (high - low) / (2 * step), rtol=1e-5)


def scanned(sections, close, factor):
    """Sections of the scanned fuselage, the first `close` of them drawn together."""
    grid = data("fuselage_d150_100x400")["grid"][:, np.linspace(0, 399, sections).astype(int)]
    centre = grid[:, 0].mean(axis=0)
    grid[:, :close] = centre + factor * (grid[:, :close] - centre)
    return grid


@pytest.mark.parametrize(("close", "factor", "solved"), [(0, 1.0, False), (4, 0.02, True), (8, 0.02, True)])
def test_an_airliner_is_met_with_sections_far_apart_and_close_together(close, factor, solved):
    fit = jf.interpolate(scanned(30, close, factor))
    assert bool(fit.converged), fit.message
    assert bool(fit.stats["solved"]) == solved
    assert float(fit.maximum_error) <= (1e-14 if solved else 1e-12)
    assert int(fit.stats["num_steps"]) <= 200
