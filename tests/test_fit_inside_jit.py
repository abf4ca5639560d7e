"""Fits where only some of the arguments are traced, and what they raise there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_except, wavy_cloud, wavy_grid

import jaxfit as jf

GRID = wavy_grid(8, 7)
POINTS, EDGES = wavy_cloud(300)
BASE = jf.base_surface(jf.Boundary(**EDGES), net=(6, 6))
GRID_METHODS = [jf.GeometricInterpolation(), jf.StandardInterpolation()]


def name(method):
    return type(method).__name__


@pytest.mark.parametrize("method", GRID_METHODS, ids=name)
def test_a_grid_known_while_tracing_is_fitted_there(method):
    fit = jf.interpolate(GRID, method)
    maximum, tripled = jax.jit(lambda x: (jf.interpolate(GRID, method).maximum_error, 3 * x))(2.0)
    assert float(maximum) == float(fit.maximum_error)
    assert float(tripled) == 6


def test_a_cloud_known_while_tracing_is_fitted_there():
    boundary = jf.Boundary(**EDGES)

    def point(u):
        options = dict(net=(6, 6), method=jf.GeometricApproximation(), base=jf.Meshless())
        return jf.fit_points(POINTS, boundary, **options).surface(u, u)

    np.testing.assert_allclose(jax.jit(point)(0.3), point(0.3), rtol=1e-12)
    nearest = jax.jit(lambda x: x + jf.closest_point(BASE, POINTS).distance)(0.0)
    np.testing.assert_allclose(nearest, jf.closest_point(BASE, POINTS).distance)


@pytest.mark.parametrize("method", slow_except(GRID_METHODS, GRID_METHODS[1]), ids=name)
def test_tolerances_of_grids_may_be_traced(method):
    def error(tolerance):
        return jf.interpolate(GRID, method, tolerance=tolerance).maximum_error

    tolerances = jnp.array([1e-5, 1e-7])
    assert (np.asarray(jax.vmap(error)(tolerances)) <= np.asarray(tolerances)).all()
    np.testing.assert_allclose(jax.jit(error)(1e-5), error(1e-5), rtol=1e-3)


@pytest.mark.parametrize(
    ("method", "known"),
    [
        pytest.param(jf.GeometricApproximation(), "weights", marks=pytest.mark.slow),
        (jf.StandardApproximation(), "points"),
    ],
    ids=["points", "weights and tolerance"],
)
def test_points_weights_and_tolerances_of_clouds_may_be_traced(method, known):
    def error(points, weights, tolerance):
        return jf.approximate(
            POINTS if known == "points" else points,
            BASE,
            method,
            tolerance,
            max_steps=4,
            weights=None if known == "weights" else weights,
        ).average_error

    arguments = jnp.asarray(POINTS), jnp.ones(300), 1e-6
    assert abs(float(jax.jit(error)(*arguments)) - float(error(*arguments))) < 1e-9


def test_steps_of_orthogonal_distance_on_a_small_net_depend_little_on_rounding():
    def net(points):
        options = dict(tol_average=0.0, max_steps=20)
        return jf.approximate(points, BASE, **options).surface.control_points

    np.testing.assert_allclose(jax.jit(net)(jnp.asarray(POINTS)), net(POINTS), rtol=0, atol=1e-10)


@pytest.mark.parametrize("method", [jf.StandardInterpolation(), jf.GeometricApproximation()], ids=name)
def test_single_and_half_precision_are_fitted_in_the_sessions_own(method):
    data = GRID if isinstance(method, jf.StandardInterpolation) else POINTS

    def net(data):
        if isinstance(method, jf.StandardInterpolation):
            return jf.interpolate(data, method).surface.control_points
        return jf.approximate(data, BASE, method, max_steps=2).surface.control_points

    rounded = jnp.asarray(data, jnp.float16 if data is GRID else jnp.float32)
    inside = jax.jit(net)(rounded)
    assert inside.dtype == jnp.float64
    np.testing.assert_allclose(inside, net(np.asarray(rounded)), atol=1e-9)


def test_throw_raises_whatever_is_made_of_the_fit():
    def net(points):
        options = dict(tol_average=1e-15, max_steps=2, throw=True)
        fit = jf.approximate(points, BASE, jf.GeometricApproximation(), **options)
        return fit.surface.control_points

    with pytest.raises(Exception, match="did not converge: the maximum number of iterations was reached"):
        jax.block_until_ready(jax.jit(net)(POINTS))


def test_numbers_beyond_sense_get_a_sentence():
    with pytest.raises(TypeError, match="max_steps"):
        jax.jit(lambda steps: jf.interpolate(GRID, max_steps=steps).maximum_error)(5)
    with pytest.raises(ValueError, match="max_steps must be at most 2147483646"):
        jf.interpolate(GRID, max_steps=10**10)
    with pytest.raises(ValueError, match="foot_tolerance must be a number of at least 0"):
        jf.GeometricInterpolation(foot_tolerance=np.nan)
    with pytest.raises(ValueError, match="restart must be a whole number of at least 1"):
        jf.StandardInterpolation(restart=0)


@pytest.mark.float32_too
@pytest.mark.parametrize("method", GRID_METHODS, ids=name)
def test_data_beyond_the_number_range_gets_a_sentence(method):
    info = jnp.finfo(float)
    within = float(info.max) / 4 / np.abs(GRID).max()
    if np.dtype(info.dtype) == np.float32:
        fit = jf.interpolate(within * GRID, method)
        assert bool(fit.converged)
        assert float(fit.maximum_error) > 0
    for scale in (float(info.tiny) / 10, *((1e150,) if np.dtype(info.dtype) == np.float32 else ())):
        with pytest.raises(ValueError, match="grid must keep to the range of float"):
            jf.interpolate(scale * GRID, method)


@pytest.mark.float32_too
def test_rounding_alone_is_no_excuse_for_any_error():
    far = GRID + 1e7 * jnp.finfo(float).eps / 1e-7 * np.array([1.0, 0.0, 0.0])
    fit = jf.interpolate(np.asarray(far), jf.StandardInterpolation())
    assert float(fit.stats["tolerance"]) <= 1e-3
    assert not bool(fit.converged) or float(fit.maximum_error) <= 1e-3


def test_fit_points_takes_traced_tolerances_and_weights():
    """What it says about the sides of the boundary needs numbers, and is left out."""
    boundary = jf.Boundary(**wavy_cloud(200)[1])
    method = jf.StandardApproximation(1e-3)

    def error(tolerance, weights):
        options = dict(net=(6, 7), method=method, max_steps=2, tol_average=tolerance, weights=weights)
        return jf.fit_points(wavy_cloud(200)[0], boundary, **options).average_error

    arguments = 1e-3, np.ones(200)
    np.testing.assert_allclose(jax.jit(error)(*arguments), error(*arguments), rtol=1e-9)
