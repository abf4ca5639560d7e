"""Fits that insert knots on the way: exactly, in one compilation, and cut to size at the end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations, wavy_cloud

import jaxfit as jf
from jaxfit._approximation._knot_insertion import insert_in_worst_spans
from jaxfit._fit._working_surface import WorkingSurface

POINTS, EDGES = wavy_cloud(500, height=0.3)
GROWING = jf.GeometricApproximation(insertion=jf.KnotInsertion(every=10, most=3), fairing=jf.Fairing())
OPTIONS = dict(tol_average=1e-9, max_steps=35)


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(jf.Boundary(**EDGES), net=(7, 6))


@pytest.fixture(scope="module")
def fit(base):
    return jf.approximate(POINTS, base, GROWING, **OPTIONS)


def test_each_insertion_adds_a_row_and_a_column(fit):
    assert fit.surface.shape == (10, 9)
    net = np.asarray(fit.history.net)
    grown = np.flatnonzero(np.asarray(fit.history.refined))
    assert grown.tolist() == [10, 20, 30]
    for step, size in zip((0, 10, 20, 30), ((7, 6), (8, 7), (9, 8), (10, 9)), strict=True):
        assert tuple(net[step]) == size
    assert np.flatnonzero(np.asarray(fit.history.faired)).tolist() == [20]
    assert (np.asarray(fit.history.active) == len(POINTS)).all()


def test_errors_are_those_of_the_surface_cut_to_size(fit):
    feet = jf.closest_point(fit.surface, POINTS)
    assert np.abs(np.asarray(feet.distance) / fit.stats["diagonal"] - np.asarray(fit.errors)).max() < 1e-9
    inner = np.asarray(fit.surface.knots_u)[4:-4]
    assert (np.diff(inner) > 0).all()
    assert fit.surface.knots_u.shape[0] == 14


def test_the_surface_is_the_same_before_and_after_an_insertion(base):
    surface = WorkingSurface.of(base.control_points, base.knots_u, base.knots_v).padded(2, 2)
    u, v = np.random.default_rng(0).random((2, 300))
    error = np.where((u > 0.6) & (v < 0.3), 1.0, 0.01)
    for _ in range(2):
        surface = jax.jit(insert_in_worst_spans)(surface, *map(jnp.asarray, (u, v, error)))
    after = jf.BSplineSurface(surface.control_points, surface.knots_u, surface.knots_v)
    assert np.abs(np.asarray(after(u, v) - base(u, v))).max() < 1e-14
    added = np.setdiff1d(np.asarray(surface.knots_u), np.asarray(base.knots_u))
    assert added.size == 2
    assert (added > 0.5).all()
    full = jax.jit(insert_in_worst_spans)(surface, *map(jnp.asarray, (u, v, error)))
    assert (np.asarray(full.control_points) == np.asarray(surface.control_points)).all()


def test_three_insertions_compile_the_loop_once_and_another_cloud_not_at_all(base, fit):
    with count_compilations() as compiled:
        again = jf.approximate(POINTS[:-20] + 1e-3, base, GROWING, **OPTIONS)
    assert again.surface.shape == (10, 9)
    assert compiled.count == 0


def test_batches_grow_each_their_own_way(base):
    feet = jf.closest_point(base, POINTS)
    bumps = np.stack([np.exp(-30 * ((POINTS[:, :2] - c) ** 2).sum(axis=1)) for c in (0.25, 0.75)])
    clouds = POINTS[None] + 0.1 * bumps[..., None] * np.array([0.0, 0.0, 1.0])

    def surface(points):
        fit = jf.approximate(points, base, GROWING, start=(feet.u, feet.v), **OPTIONS)
        return fit.surface, fit.average_error

    both, averages = jax.jit(jax.vmap(surface))(jnp.asarray(clouds))
    assert not np.allclose(both.knots_u[0], both.knots_u[1])
    for k in range(2):
        alone, average = surface(clouds[k])
        np.testing.assert_allclose(both.knots_u[k][:14], alone.knots_u, atol=1e-12)
        np.testing.assert_allclose(both.control_points[k][:10, :9], alone.control_points, atol=1e-9)
        assert abs(float(averages[k] - average)) < 1e-6


@pytest.mark.slow
def test_one_step_feet_come_as_close_as_converged_ones(base):
    ends = []
    for single_step in (False, True):
        method = jf.GeometricApproximation(relaxation=1.0, acceleration=None, single_step=single_step)
        fit = jf.approximate(POINTS, base, method, tol_average=1e-3)
        assert bool(fit.converged), fit.message
        feet = jf.closest_point(fit.surface, POINTS)
        assert np.abs(np.asarray(feet.distance) / fit.stats["diagonal"] - np.asarray(fit.errors)).max() < 1e-9
        ends.append((int(fit.stats["num_steps"]), float(np.mean(np.asarray(fit.history.evaluations)[1:-1]))))
    assert abs(ends[0][0] - ends[1][0]) <= 1
    assert ends[1][1] <= 1.0 < ends[0][1]


def test_the_papers_setting_is_at_hand():
    method = jf.GeometricApproximation.paper(fairing=None)
    assert (method.relaxation, method.acceleration, method.single_step) == (1.0, None, False)
    assert method.fairing is None
    assert method.insertion == jf.KnotInsertion(every=40)
    with pytest.raises(ValueError, match="every must be"):
        jf.KnotInsertion(every=0)


@pytest.mark.slow
def test_local_mode_meets_the_tolerance_and_leaves_the_rest_to_the_bit():
    base = jf.base_surface(jf.Boundary(**EDGES), net=(12, 12))
    points = np.asarray(base(*np.random.default_rng(1).random((2, 500))))
    bump = np.exp(-60 * ((points[:, :2] - 0.7) ** 2).sum(axis=1))
    points = points + 0.05 * bump[:, None] * np.array([[0.0, 0.0, 1.0]])
    ends = []
    for local in (False, True):
        method = jf.GeometricApproximation(local=local)
        ends.append(jf.approximate(points, base, method, tol_average=None, tol_maximum=4e-3, max_steps=300))
    assert all(bool(fit.converged) for fit in ends)
    same = [np.asarray(x.surface.control_points == base.control_points).all(axis=2) for x in ends]
    assert same[1].sum() > same[0].sum()
    active = np.asarray(ends[1].history.active)
    assert active[0] == 500 > active[1:-1].max()
