"""What functions of arrays on the host returned is found again by contents, and nobody can change it."""

import helpers
import numpy as np
import pytest

import jaxfit as jf
from jaxfit._closest import _reach, _surface_search
from jaxfit._closest._reach import Reach
from jaxfit._remembered import remembered
from jaxfit._splines._pieces import make_axis

RNG = np.random.default_rng(0)


def test_equal_arrays_are_asked_about_once():
    asked = []

    @remembered(2)
    def double(x, factor):
        asked.append(x)
        return factor * x

    x = np.arange(3.0)
    first = double(x, 2)
    assert double(x.copy(), 2) is first
    x[0] = 5.0  # the caller's own, which is not what is remembered
    assert double(x, 2).tolist() == [10.0, 2.0, 4.0]
    assert double(np.arange(3.0), 2) is first
    assert len(asked) == 2
    double(np.arange(3.0, dtype=np.float32), 2), double(np.arange(3.0).reshape(3, 1), 2)
    assert [x.shape for x in asked] == [(3,), (3,), (3,), (3, 1)]  # neither type nor shape is left out
    assert double(np.arange(3.0), 2) is not first  # the oldest is forgotten
    with pytest.raises(ValueError, match="read-only"):
        asked[0][0] = 1.0


def test_prepared_knots_are_shared_and_cannot_be_written_to():
    knots = np.asarray(jf.clamped_uniform_knots(7, 4))
    axis = make_axis(knots, 4)
    assert make_axis(knots.copy(), 4) is axis
    assert make_axis(knots, 3) is not axis
    with pytest.raises(ValueError, match="read-only"):
        axis.polynomials[0] = 0.0


def test_the_reach_at_a_sample_is_found_once(monkeypatch):
    surface, asked = helpers.wavy_surface(9, 8), []
    axes = [make_axis(np.asarray(x), 4) for x in (surface.knots_u, surface.knots_v)]
    net, at = np.asarray(surface.control_points), Reach._reach_at

    def counted(self, number, count):
        asked.extend((count, x) for x in number)
        return at(self, number, count)

    monkeypatch.setattr(Reach, "_reach_at", counted)
    monkeypatch.setattr(_reach, "POINTS_PER_SAMPLE", 0)
    reach = Reach(net, *axes)
    for part in (slice(0, 200), slice(100, 2000), slice(0, 2000)):
        u, v = RNG.uniform(size=(2, 2000))[:, part]
        distance = 10 ** RNG.uniform(-3, 0, u.size)
        below = reach.exceeds(u, v, distance)
        before = len(asked)
        np.testing.assert_array_equal(below, Reach(net, *axes).exceeds(u, v, distance))
        del asked[before:]
    assert len(asked) == len(set(asked)) > 0


def test_queries_one_after_the_other_sample_a_surface_once(monkeypatch):
    surface, sampled, sample = helpers.wavy_surface(9, 8), [], _surface_search.sample
    monkeypatch.setattr(_surface_search, "sample", lambda *args: sampled.append(args) or sample(*args))
    moved = jf.BSplineSurface(surface.control_points + 1e-3, surface.knots_u, surface.knots_v)
    points = np.asarray(surface(*RNG.uniform(size=(2, 500)))) + 0.05 * RNG.normal(size=(500, 3))
    found = [jf.closest_point(x, points) for x in (surface, surface, moved)]
    np.testing.assert_array_equal(found[0].distance, found[1].distance)
    assert abs(found[2].distance - found[0].distance).max() > 1e-4
    assert len(sampled) <= 2


def test_fits_from_one_base_find_its_reach_once_however_many_end_in_between(monkeypatch):
    base, made, reach = helpers.wavy_surface(6, 6), [], Reach.__init__
    monkeypatch.setattr(Reach, "__init__", lambda self, *args: made.append(args) or reach(self, *args))
    u, v = RNG.uniform(size=(2, 4000))
    x, y, z = np.asarray(base(u, v)).T
    clouds = [np.stack([x, y, z + 0.02 * k * np.sin(9 * x)], axis=1) for k in range(1, 6)]
    method = jf.GeometricApproximation()
    for cloud in clouds:
        jf.approximate(cloud, base, method, tol_average=1e-9, max_steps=2)
    assert len(made) == 1 + len(clouds)  # the base, and where each fit ended
