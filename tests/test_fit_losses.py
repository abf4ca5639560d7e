"""Robust losses: their weights are the derivatives of their costs, and outliers do not spoil a fit."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import diagonal, wavy_cloud

import jaxfit as jf
from jaxfit._approximation._losses import reweighted, total_cost

POINTS, EDGES = wavy_cloud(500)
LOSSES = [jf.Huber(), jf.Tukey(), jf.GemanMcClure()]


def named(x):
    return type(x).__name__


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(jf.Boundary(**EDGES), net=(8, 7))


@pytest.fixture(scope="module")
def wild():
    """The cloud with 5 % gross outliers."""
    rng = np.random.default_rng(3)
    points = POINTS.copy()
    points[rng.choice(500, 25, replace=False), 2] += rng.uniform(0.1, 0.3, 25)
    return points


@pytest.mark.parametrize("loss", LOSSES, ids=named)
def test_the_derivative_is_that_of_the_cost(loss):
    square = jnp.asarray([0.0, 0.1, 0.5, 0.9, 1.5, 4.0, 100.0])
    slope = jax.vmap(jax.grad(loss.cost))(square)
    assert np.abs(np.asarray(slope - loss.derivative(square))).max() < 1e-12
    assert float(loss.cost(jnp.asarray(0.0))) == 0
    assert float(loss.derivative(jnp.asarray(0.0))) == 1


@pytest.mark.parametrize("loss", LOSSES, ids=named)
def test_the_scale_follows_from_the_points(loss):
    rng = np.random.default_rng(0)
    error = jnp.asarray(np.abs(rng.normal(size=4001)) * 0.01)
    real = jnp.arange(4001) < 4000
    length = float(loss.length(error.at[-1].set(1e6), real, jnp.asarray(3.0), 100))
    assert abs(length - 0.01 * loss.width) < 0.03 * length
    fixed = type(loss)(scale=0.02)
    assert float(fixed.length(error, real, jnp.asarray(3.0), 100)) == pytest.approx(0.06)


@pytest.mark.parametrize(("share", "most"), [(0.1, 1.3), (0.2, 1.5), (0.3, 2.1)])
def test_a_share_of_outliers_does_not_become_the_scale(share, most):
    rng = np.random.default_rng(0)
    error = np.abs(rng.normal(size=4000)) * 0.01
    error[rng.choice(4000, int(share * 4000), replace=False)] = rng.uniform(1, 2, int(share * 4000))
    length = jf.Tukey().length(error, np.full(4000, True), jnp.asarray(3.0), 100)
    assert 0.01 < float(length) / jf.Tukey.width < most * 0.01


@pytest.mark.parametrize("parameter_correction", [True, False])
def test_a_feature_of_a_plate_that_is_met_elsewhere_is_no_outlier(parameter_correction):
    # A fifth of the points make it up, in no order; all others have no error at all.
    x, y = np.random.default_rng(0).uniform(size=(2, 2000))
    inside = 1 - ((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.25**2
    points = np.stack([x, y, 0.12 * np.maximum(inside, 0.0) ** 2], axis=1)
    line = np.linspace(0, 1, 40)
    flat = jf.Boundary.from_grid(np.stack([*np.meshgrid(line, line, indexing="ij"), np.zeros((40, 40))], 2))
    base = jf.base_surface(flat, net=(12, 12))
    method = jf.StandardApproximation(1e-7, loss=jf.Tukey(), parameter_correction=parameter_correction)
    fit = jf.approximate(points, base, method, tol_average=0.0, max_steps=15)
    assert float(fit.maximum_error) < 5e-3


def test_points_of_no_weight_do_not_change_the_scale():
    error = np.abs(np.random.default_rng(0).normal(size=500))
    every_fifth = np.arange(0, 500, 5)
    padded, real = np.insert(error, every_fifth, 7.0), np.insert(np.full(500, True), every_fifth, False)
    lengths = [jf.Tukey().length(*x, 1.0, 30) for x in ((error, np.full(500, True)), (padded, real))]
    assert lengths[0] == lengths[1]


@pytest.mark.parametrize("loss", LOSSES, ids=named)
def test_a_fifth_of_outliers_hardly_moves_a_surface(loss, base):
    points, rng = wavy_cloud(2000)[0], np.random.default_rng(3)
    wild = points.copy()
    wild[:400] = points.min(axis=0) + np.ptp(points, axis=0) * rng.uniform(-0.1, 1.1, (400, 3))
    fit = jf.approximate(wild, base, jf.OrthogonalDistance(loss=loss), tol_average=0.0, max_steps=40)
    distance = np.asarray(jf.closest_point(fit.surface, points).distance) / diagonal(points)
    assert distance.mean() < 1e-4
    assert fit.regularity.folds == 0


def test_least_squares_is_no_loss_at_all():
    weight, error = jnp.ones(3), jnp.arange(3.0)
    assert reweighted(None, None, weight, error) is weight
    assert float(total_cost(None, None, weight, error)) == 5.0
    far = total_cost(jf.Tukey(scale=1.0), jnp.asarray(1e3), weight, error)
    assert abs(float(far) - 5.0) < 1e-4


@pytest.mark.slow
def test_outliers_do_not_spoil_orthogonal_distance(base, wild):
    assert spoilt(jf.OrthogonalDistance(loss=jf.Huber()), base, wild, 10) < 5e-4


@pytest.mark.parametrize(
    ("method", "steps"),
    [
        (jf.StandardApproximation(loss=jf.Tukey()), 10),
        (jf.GeometricApproximation(loss=jf.GemanMcClure()), 60),
    ],
    ids=named,
)
def test_outliers_do_not_spoil_the_other_methods(base, wild, method, steps):
    assert spoilt(method, base, wild, steps) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES, ids=named)
def test_detail_too_fine_for_the_net_is_no_outlier(loss):
    rng = np.random.default_rng(0)
    x, y = rng.random((2, 4000))
    middles = rng.uniform(0.2, 0.8, (4, 2))
    height = 3e-3 * sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.002) for a, b in middles)
    clean = np.stack([x, y, height], axis=1)
    noisy = clean + 1e-4 * rng.normal(size=clean.shape)
    noisy[:40, 2] += rng.uniform(0.1, 0.3, 40)
    knots = jf.clamped_uniform_knots(16, 4)
    places = jf.greville_abscissae(knots, 4)
    flat = np.stack([*np.meshgrid(places, places, indexing="ij"), np.zeros((16, 16))], axis=-1)

    def farthest(points, loss):
        method = jf.StandardApproximation(smoothing=1e-8, loss=loss)
        base = jf.BSplineSurface(flat, knots, knots)
        fit = jf.approximate(points, base, method, tol_average=1e-9, max_steps=10)
        return float(jnp.max(jf.closest_point(fit.surface, clean).distance))

    assert farthest(noisy, loss) < 1.6 * farthest(clean, None)


def test_outliers_spoil_least_squares(base, wild):
    assert spoilt(jf.GeometricApproximation(), base, wild, 60) > 3e-3


def spoilt(method, base, wild, steps):
    """Average distance of the clean points from a surface fitted to the others, against the diagonal."""
    fit = jf.approximate(wild, base, method, max_steps=steps, tol_average=1e-12)
    return float(jnp.mean(jf.closest_point(fit.surface, POINTS).distance)) / diagonal(POINTS)


@pytest.mark.parametrize("kind", [jf.Huber, jf.Tukey, jf.GemanMcClure], ids=lambda x: x.__name__)
@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan])
def test_impossible_scales_get_a_sentence(kind, scale):
    with pytest.raises(ValueError, match="scale"):
        kind(scale=scale)


@pytest.mark.parametrize(
    "kind",
    [jf.GeometricApproximation, jf.OrthogonalDistance, jf.StandardApproximation],
    ids=lambda x: x.__name__,
)
def test_a_loss_of_another_kind_gets_a_sentence(kind):
    with pytest.raises(TypeError, match="loss must be an object"):
        kind(loss="huber")


@pytest.mark.parametrize("kind", [jf.OrthogonalDistance, partial(jf.StandardApproximation, 1e-9)])
def test_a_border_that_is_met_exactly_does_not_hold_the_rest(kind):
    # Its points count in full, all others a hundred millionth of that.
    line, zero = np.linspace(0, 1, 40), np.zeros(40)
    sides = [
        np.stack(side, axis=1) for side in ((line, zero), (line, zero + 1), (zero, line), (zero + 1, line))
    ]
    border = [np.column_stack([side, zero]) for side in sides]
    x, y = np.random.default_rng(0).uniform(0.05, 0.95, (2, 800))
    inner = np.stack([x, y, 0.1 * np.sin(np.pi * x) * np.sin(np.pi * y)], axis=1)
    base = jf.base_surface(jf.Boundary(*border), net=(8, 8))
    points = np.concatenate([*border, inner])
    fit = jf.approximate(points, base, kind(loss=jf.Huber(1e-9)), tol_average=0.0, max_steps=30)
    assert float(fit.average_error) < 1e-3
