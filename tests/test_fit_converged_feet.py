"""Feet that a pass over the points finds and proves: against feet that converge step by step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import eps, random_surface, wavy_cloud, wavy_surface

import jaxfit as jf
from jaxfit._approximation._control_point_sums import _above_rounding, pull
from jaxfit._approximation._foot_updates import Arrive
from jaxfit._cells import KeptRows, cells_of
from jaxfit._fit._problem import Problem
from jaxfit._splines._pieces import make_pieces

POINTS, EDGES = wavy_cloud(1500)
EVERYTHING = jf.Huber(1e9)  # a loss that weighs all points alike, and makes feet converge before they pull


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(jf.Boundary(**EDGES), net=(9, 8))


def fits(base, **options):
    """The same steps with both ways to converged feet."""
    changes = dict(insertion=None, fairing=None, foot_tolerance=1e-11, stall_window=1000) | options
    ways = (jf.GeometricApproximation.paper(**changes, loss=loss) for loss in (None, EVERYTHING))
    return [jf.approximate(POINTS, base, way, max_steps=25, tol_average=1e-9) for way in ways]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"fairing": jf.Fairing(every=5)},
        {"insertion": jf.KnotInsertion(every=6)},
        {"border": jf.FixedCorners(), "relaxation": 1.7},
    ],
    ids=lambda x: "+".join(x) or "plain",
)
def test_both_ways_to_converged_feet_give_the_same_surface(base, options):
    once, stepwise = fits(base, **options)
    assert once.surface.shape == stepwise.surface.shape
    difference = np.asarray(once.surface.control_points) - np.asarray(stepwise.surface.control_points)
    assert np.abs(difference).max() < 1e-8
    np.testing.assert_allclose(once.history.average, stepwise.history.average, rtol=1e-7)


def test_a_foot_takes_one_evaluation_where_surfaces_move_little(base):
    once, stepwise = fits(base)
    assert np.asarray(once.history.evaluations)[10:].max() < 1.05
    assert np.asarray(stepwise.history.evaluations)[10:].min() > 1.5


def test_starts_far_from_their_feet_are_left_to_the_safeguarded_method(base):
    start = np.full(1500, 0.5), np.full(1500, 0.5)
    way = jf.GeometricApproximation.paper(insertion=None, fairing=None)
    far = jf.approximate(POINTS, base, way, max_steps=3, tol_average=1e-9, start=start)
    near = jf.approximate(POINTS, base, way, max_steps=3, tol_average=1e-9)
    assert np.asarray(far.history.evaluations)[0] > 4
    assert np.median(np.abs(np.asarray(far.errors) - np.asarray(near.errors))) < 1e-3


@pytest.mark.float32_too
@pytest.mark.parametrize("surface", [wavy_surface(), random_surface(order=(5, 4))], ids=["wavy", "random"])
@pytest.mark.parametrize("off", [1e-3, 3e-2])
def test_what_counts_as_certain_is_a_foot(surface, off):
    rng, count = np.random.default_rng(3), 700
    u, v = rng.uniform(0, 1, (2, count))
    beside = rng.normal(size=(count, 3)) * 0.01
    target = np.asarray(surface(u, v)) + beside
    dtype = surface.control_points.dtype
    start = [jnp.asarray(np.clip(x + off * rng.normal(size=count), 0, 1), dtype) for x in (u, v)]
    pieces = make_pieces(*(np.asarray(x) for x in (surface.control_points, surface.knots_u, surface.knots_v)))
    tolerance, one = max(1e-9, 1e3 * eps()), jnp.ones(count, dtype)

    @jax.jit
    def gather(diagonal, u, v):
        axes = (pieces.axis_u, pieces.axis_v)
        problem = Problem(
            jnp.asarray(target.T, dtype), one, *axes, one, diagonal, jnp.asarray(tolerance, dtype)
        )
        return pull(problem, pieces, u, v, 0 * u, u < 0, lambda weight, error: weight, Arrive())

    feet, looks, gone, _, active = gather(jnp.asarray(1.0, dtype), *start)
    certain = np.asarray(looks) > 0
    assert certain.sum() == active
    # Who is found in another cell than it started from has left that, and no one found at first sight has.
    ends = np.asarray(feet[:2])
    moved = cells_of(pieces, *(np.asarray(x) for x in start)) != cells_of(pieces, *ends)
    assert np.asarray(gone)[certain & moved & ~on_a_knot(pieces, *ends)].all()
    assert not np.asarray(gone)[np.asarray(looks) == 1].any()
    assert certain.mean() > (0.9 if off < 1e-2 else 0.2)
    u, v = np.asarray(feet[:2])[:, certain]
    e = target[certain] - np.asarray(surface(u, v))
    np.testing.assert_allclose(np.linalg.norm(e, axis=1), feet[2][certain], atol=20 * tolerance)
    for x, du, dv in ((u, 1, 0), (v, 0, 1)):
        tangent = np.asarray(surface.derivative(u, v, du, dv))
        across = np.sum(e * tangent, axis=1) / np.linalg.norm(tangent, axis=1)
        assert np.abs(across[(x > 0) & (x < 1)]).max() <= 1.01 * tolerance + 50 * eps()


def on_a_knot(pieces, u, v):
    axes = (pieces.axis_u, pieces.axis_v)
    off = [
        np.abs(x[:, None] - np.asarray(axis.breaks)).min(axis=1) for axis, x in zip(axes, (u, v), strict=True)
    ]
    return np.minimum(*off) < 1e-5


def assert_kept(kept, pieces, u, v, left_out):
    rows, points = kept.rows, len(u)
    point, filled = np.asarray(rows.point), np.asarray(rows.point) < points
    np.testing.assert_array_equal(np.sort(point[filled]), np.flatnonzero(~left_out))
    cell = pieces.axis_u.locate(u) * pieces.axis_v.cells + pieces.axis_v.locate(v)
    owner = np.broadcast_to(np.asarray(rows.cell)[:, None], point.shape)
    np.testing.assert_array_equal(owner[filled], cell[point[filled]])
    assert not filled[int(rows.used) :].any()


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 1.0])
def test_kept_rows_hold_every_point_in_a_row_of_its_cell(share):
    rng, count = np.random.default_rng(5), 2000
    surface = wavy_surface(9, 8)
    pieces = make_pieces(*(np.asarray(x) for x in (surface.control_points, surface.knots_u, surface.knots_v)))
    follow = jax.jit(lambda kept, *x: kept.followed(pieces, *x))
    u, v = rng.uniform(0, 1, (2, count))
    left_out = rng.uniform(size=count) < 0.1
    kept, moved = KeptRows.none(count, pieces.cells), np.ones(count, bool)
    for _ in range(8):
        kept = follow(kept, u, v, left_out, moved)
        assert_kept(kept, pieces, u, v, left_out)
        moved = rng.uniform(size=count) < share
        u, v = (np.where(moved, rng.uniform(0, 1, count), x) for x in (u, v))


@pytest.mark.float32_too
def test_only_sums_that_rounding_decides_count_as_none():
    heavy, light = 3e4, 1e-3
    total = np.zeros((30, 20))
    total[2, 3], total[5, 5], total[8, 6] = heavy, 1e-9 * heavy, 1e-9 * heavy  # the last shares no cell
    total[20:25, 10:14], total[21, 12] = light, 1e-14 * light
    sums = jnp.asarray(np.stack([2.0 * total, total], axis=-1), jnp.result_type(float))
    kept = np.asarray(_above_rounding(sums, (4, 4)))
    single = sums.dtype == jnp.float32
    expected = np.asarray(sums).copy()
    expected[21, 12] = 0.0
    if single:
        expected[5, 5] = 0.0
    np.testing.assert_array_equal(kept, expected)
