"""Systems that the data leaves open: fits stay near the data and near the base, and say what they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_except

import jaxfit as jf

METHODS = (jf.StandardApproximation, jf.OrthogonalDistance)


def flat_base(n):
    knots = jf.clamped_uniform_knots(n, 4)
    places = jf.greville_abscissae(knots, 4)
    x, y = np.meshgrid(places, places, indexing="ij")
    return jf.BSplineSurface(np.stack([x, y, 0 * x], axis=-1), knots, knots)


def cloud(count):
    x, y = np.random.default_rng(3).random((2, count))
    return np.stack([x, y, 0.1 * np.sin(5 * x) * np.cos(4 * y)], axis=1)


@pytest.mark.parametrize("method", slow_except(METHODS, jf.StandardApproximation))
def test_a_net_too_large_for_its_points_stays_within_reach_without_smoothing(method):
    points = cloud(300)
    fit = jf.approximate(points, flat_base(30), method(smoothing=0.0), tol_average=1e-5, max_steps=12)
    assert fit.converged
    assert fit.average_error <= 1e-5
    assert int(fit.stats["unconverged_feet"]) == 0
    assert np.abs(fit.surface.control_points).max() < 30
    if method is jf.StandardApproximation:
        assert float(fit.stats["shift"]) > 0


@pytest.mark.parametrize("method", slow_except(METHODS, jf.StandardApproximation))
def test_a_region_without_points_stays_near_the_base_without_smoothing(method):
    points = cloud(400)
    points = points[~((points[:, 0] > 0.5) & (points[:, 1] > 0.5))]
    fit = jf.approximate(points, flat_base(12), method(smoothing=0.0), tol_average=1e-6, max_steps=8)
    assert fit.average_error < 2e-3
    assert np.abs(fit.surface.control_points).max() < 20


@pytest.mark.slow
def test_all_ways_to_solve_leave_the_same_control_points_alone():
    points = cloud(400)
    points = points[~((points[:, 0] > 0.5) & (points[:, 1] > 0.5))]
    solvers = (jf.GaussNewton(), jf.LevenbergMarquardt(), jf.JaxoptGaussNewton())
    nets = []
    for solver in solvers:
        method = jf.StandardApproximation(smoothing=0.0, solver=solver)
        fit = jf.approximate(points, flat_base(12), method, tol_average=1e-6, max_steps=1)
        nets.append(np.asarray(fit.surface.control_points))
    still = [np.all(net == np.asarray(flat_base(12).control_points), axis=2) for net in nets]
    assert still[0][1:-1, 1:-1].any()
    for net, kept in zip(nets, still, strict=True):
        np.testing.assert_array_equal(kept, still[0])
        np.testing.assert_allclose(net, nets[0], atol=1e-3 * np.abs(nets[0]).max())


@pytest.mark.parametrize("method", slow_except(METHODS, jf.StandardApproximation))
def test_a_single_weight_leaves_the_rest_of_the_base(method):
    points, weights = cloud(300), np.zeros(300)
    weights[7] = 1.0
    fit = jf.approximate(points, flat_base(12), method(smoothing=0.0), weights=weights, max_steps=20)
    assert np.abs(fit.surface.control_points).max() < 5
    assert fit.average_error < 0.1
    assert "There are 144 control points for 1 point" in fit.message
    assert "12 x 12, more control points than points" in str(fit)


@pytest.mark.parametrize("method", slow_except(METHODS, jf.StandardApproximation))
def test_a_traced_smoothing_that_is_none_is_told(method):
    points, base = cloud(300), flat_base(8)
    fit = jax.jit(lambda x: jf.approximate(points, base, method(smoothing=x), tol_average=1e-5, max_steps=6))
    assert fit(1e-6).result == jf.RESULTS.max_steps_reached
    for smoothing in (-1e-3, jnp.nan, jnp.inf):
        found = fit(smoothing)
        assert found.result == jf.RESULTS.diverged
        np.testing.assert_array_equal(found.surface.control_points, base.control_points)
        assert np.isfinite(found.average_error)


def test_control_points_that_rounding_takes_off_the_points_are_told():
    near, base, method = cloud(300), flat_base(8), jf.StandardApproximation()
    fit = jf.approximate(near, base, method, tol_average=1e-2)
    assert fit.converged
    far = near + 1e6
    net = np.asarray(base.control_points, np.float32) + np.float32(1e6)
    knots = [np.asarray(x, np.float32) for x in (base.knots_u, base.knots_v)]
    rounded = jf.approximate(far, jf.BSplineSurface(net, *knots), method, tol_average=1e-2)
    assert rounded.result == jf.RESULTS.rounded
    assert not rounded.converged
    assert "the rounding of the control points keeps the errors above" in rounded.message
    # Units in the last place of 1e6 are 1/16, so a control point is off by up to 1/32 in each coordinate.
    assert rounded.average_error > np.sqrt(3) / 32 / float(rounded.stats["diagonal"])
    exact = jf.BSplineSurface(net.astype(float), base.knots_u, base.knots_v)
    assert jf.approximate(far, exact, method, tol_average=1e-2).converged
