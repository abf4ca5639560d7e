"""The curve fit lowers the error, leaves what no point touches, and refines without moving."""

import helpers
import numpy as np
import pytest
from scipy.interpolate import BSpline

from jaxfit._base._curve_fit import CurveStart, fit_curves
from jaxfit._base._opposite_curves import starts_by_count, starts_by_tolerance
from jaxfit._splines import BSplineCurve, averaging_knots

ORDER = 4
EMPTY = np.zeros(0)


def wave(count=80, height=0.2):
    x = np.linspace(0, 1, count)
    return np.stack([x, height * np.sin(4 * x), 0 * x], axis=1)


def fitted(start, steps=100):
    dtype = np.dtype(np.float64 if helpers.eps() < 1e-12 else np.float32)
    ((control, knots),) = fit_curves([start], ORDER, 0.0, steps, dtype)
    return BSplineCurve(control, knots)


def distance(curve, points):
    knots, control = np.asarray(curve.knots, float), np.asarray(curve.control_points, float)
    fine = BSpline(knots, control, ORDER - 1)(np.linspace(0, 1, 4001))
    return np.linalg.norm(points[:, None] - fine[None], axis=-1).min(axis=1)


@pytest.mark.float32_too
def test_the_error_falls_step_by_step_and_the_ends_stay():
    start = starts_by_count((wave(), wave(height=0.1)), ORDER, 8, 1e-3)[0]
    averages = [distance(fitted(start, steps), wave()).mean() for steps in (0, 1, 4, 16, 100)]
    assert (np.diff(averages) < 0).all()
    assert averages[-1] < 0.1 * averages[0]
    ends = np.asarray(fitted(start).control_points)[[0, -1]]
    np.testing.assert_allclose(ends, wave()[[0, -1]], atol=4 * helpers.eps())


@pytest.mark.float32_too
def test_control_points_that_no_point_touches_stay():
    points = wave()[:20]  # a quarter of the domain only
    knots = np.concatenate([np.zeros(4), np.linspace(0, 1, 10)[1:-1], np.ones(4)])
    control = np.stack([np.linspace(0, 1, 12), np.zeros(12), np.zeros(12)], axis=1)
    start = CurveStart(points, points[:, 0], control, knots, EMPTY)
    result = np.asarray(fitted(start).control_points)
    np.testing.assert_allclose(result[6:], control[6:], atol=4 * helpers.eps())
    assert np.abs(result[1:5, 1]).min() > 1e-3


@pytest.mark.float32_too
def test_refinement_onto_the_opposite_knots_leaves_the_shape():
    pair = (wave(), wave(height=0.5) + np.array([0.0, 0.0, 1.0]))
    starts = starts_by_tolerance(pair, ORDER, 1e-3)
    assert len({len(s.control) for s in starts}) == 2
    refined = [fitted(s) for s in starts]
    np.testing.assert_array_equal(refined[0].knots, refined[1].knots)
    u = np.linspace(0, 1, 101)
    for start, fine in zip(starts, refined, strict=True):
        coarse = fitted(start._replace(new_knots=EMPTY))
        assert len(coarse.control_points) == len(start.control)
        np.testing.assert_allclose(coarse(u), fine(u), atol=20 * helpers.eps())


def test_common_knots_are_the_averages_of_common_parameters():
    starts = starts_by_count((wave(), wave(31)), ORDER, 9, 1e-3)
    np.testing.assert_array_equal(starts[0].knots, starts[1].knots)
    common = np.unique(starts[0].feet[np.isin(starts[0].points, starts[0].control).all(axis=1)])
    assert len(common) == 9
    np.testing.assert_allclose(starts[0].knots, averaging_knots(common, ORDER), atol=1e-15)


@pytest.mark.parametrize("vertices", [2, 5, 400])
def test_every_span_of_the_knots_has_points(vertices):
    for start in starts_by_count((wave(vertices), wave(33)), ORDER, 12, 1e-3):
        counts, _ = np.histogram(start.feet, np.unique(start.knots))
        assert counts.min() >= 4


def test_very_long_polylines_are_thinned():
    start = starts_by_tolerance((wave(50_000), wave()), ORDER, 1e-3)[0]
    assert len(start.points) <= 4096
    np.testing.assert_array_equal(start.points[: len(start.points)][0], wave()[0])
    assert distance(fitted(start), wave()).max() < 4e-4
