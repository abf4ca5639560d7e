"""Feet that a pass over the points finds and proves: against feet that converge step by step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import eps, random_surface, wavy_cloud, wavy_surface

import jaxfit as jf
from jaxfit._approximation._control_point_sums import ControlPointSums, _above_rounding
from jaxfit._closest import update_feet
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
        pytest.param({"fairing": jf.Fairing(every=5)}, marks=pytest.mark.slow),
        pytest.param({"insertion": jf.KnotInsertion(every=6)}, marks=pytest.mark.slow),
        pytest.param({"border": jf.FixedCorners(), "relaxation": 1.7}, marks=pytest.mark.slow),
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
    for fit in fits(base):
        assert np.asarray(fit.history.evaluations)[10:].max() < 1.05


def test_starts_far_from_their_feet_are_left_to_the_safeguarded_method(base):
    start = np.full(1500, 0.5), np.full(1500, 0.5)
    way = jf.GeometricApproximation.paper(insertion=None, fairing=None)
    far = jf.approximate(POINTS, base, way, max_steps=3, tol_average=1e-9, start=start)
    near = jf.approximate(POINTS, base, way, max_steps=3, tol_average=1e-9)
    assert np.asarray(far.history.evaluations)[0] > 4
    assert np.median(np.abs(np.asarray(far.errors) - np.asarray(near.errors))) < 1e-3


def naive_sums(surface, u, v, weight, target):
    """sum_k w_k N_i N_j (e_k, 1), from the surface's basis functions one by one."""
    nu, nv = surface.shape
    along_u, along_v = (
        dense_basis(k, n, x)
        for k, n, x in zip((surface.knots_u, surface.knots_v), (nu, nv), (u, v), strict=True)
    )
    e = target - np.asarray(surface(u, v))
    values = weight[:, None] * np.concatenate([e, np.ones((len(u), 1))], axis=1)
    return np.einsum("ki,kj,kc->ijc", along_u, along_v, values)


def dense_basis(knots, count, u):
    columns = [jf.BSplineCurve(np.eye(count)[:, i : i + 1], knots)(u)[:, 0] for i in range(count)]
    return np.stack([np.asarray(x) for x in columns], axis=1)


SURFACES = {
    "wavy": wavy_surface(),
    "random": random_surface(order=(5, 4)),
    "creased": random_surface(order=(3, 3), repeats=2),
}


@pytest.mark.float32_too
@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
@pytest.mark.parametrize("off", [1e-3, 3e-2])
def test_feet_are_found_and_summed_over_once(surface, off):
    rng, count = np.random.default_rng(3), 700
    u, v = rng.uniform(0, 1, (2, count))
    target = np.asarray(surface(u, v)) + rng.normal(size=(count, 3)) * 0.01
    dtype = surface.control_points.dtype
    start = [jnp.asarray(np.clip(x + off * rng.normal(size=count), 0, 1), dtype) for x in (u, v)]
    pieces = make_pieces(*(np.asarray(x) for x in (surface.control_points, surface.knots_u, surface.knots_v)))
    tolerance, weight = max(1e-9, 1e3 * eps()), rng.uniform(0, 1, count)
    idle = rng.uniform(size=count) < 0.1

    @jax.jit
    def update(u, v, idle):
        return update_feet(
            jf.Newton(), pieces, jnp.asarray(target.T, dtype), u, v, jnp.asarray(tolerance, dtype),
            idle=idle, sums=ControlPointSums(), weight=jnp.asarray(weight, dtype),
        )  # fmt: skip

    feet, sums = update(*start, jnp.asarray(idle))
    assert np.asarray(feet.converged).mean() > 0.97
    u, v = np.asarray(feet.u), np.asarray(feet.v)
    assert (u[idle] == start[0][idle]).all()
    e = target - np.asarray(surface(u, v))
    np.testing.assert_allclose(
        np.linalg.norm(e, axis=1)[~idle], np.asarray(feet.error)[~idle], atol=20 * tolerance
    )
    assert not np.asarray(feet.error)[idle].any()
    expected = naive_sums(surface, u[~idle], v[~idle], weight[~idle], target[~idle])
    np.testing.assert_allclose(sums.sums, expected, atol=1e3 * tolerance, rtol=1e-3)
    certain = np.asarray(feet.converged) & ~idle
    breaks = [np.unique(k) for k in (surface.knots_u, surface.knots_v)]
    for x, knots, du, dv in ((u, breaks[0], 1, 0), (v, breaks[1], 0, 1)):
        tangent = np.asarray(surface.derivative(u, v, du, dv))
        across = np.abs(np.sum(e * tangent, axis=1)) / np.linalg.norm(tangent, axis=1)
        inside = certain & (np.abs(x[:, None] - knots).min(axis=1) > 0)
        assert across[inside].max() <= 1.01 * tolerance + 50 * eps()


def test_feet_that_are_not_found_are_summed_over_at_their_best():
    surface, count = wavy_surface(), 300
    rng = np.random.default_rng(4)
    u, v = rng.uniform(0, 1, (2, count))
    target = np.asarray(surface(u, v)) + rng.normal(size=(count, 3)) * 0.05
    pieces = make_pieces(*(np.asarray(x) for x in (surface.control_points, surface.knots_u, surface.knots_v)))
    start = (jnp.asarray(rng.uniform(0, 1, count)) for _ in range(2))
    feet, sums = update_feet(
        jf.Newton(), pieces, jnp.asarray(target.T), *start, jnp.asarray(1e-12),
        idle=jnp.zeros(count, bool), max_steps=2, sums=ControlPointSums(),
    )  # fmt: skip
    assert not np.asarray(feet.converged).all()
    expected = naive_sums(surface, np.asarray(feet.u), np.asarray(feet.v), np.ones(count), target)
    np.testing.assert_allclose(sums.sums, expected, atol=1e-9)


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


def test_local_feet_that_were_lost_are_searched_on_the_whole_surface():
    surface = wavy_surface()
    u, v = np.random.default_rng(0).uniform(size=(2, 40))
    points = np.asarray(surface(u, v))
    lost = np.arange(40) % 7 == 0
    wrong = np.where(lost, 0.0, u), np.where(lost, 1.0, v)
    away = np.linalg.norm(np.asarray(surface(*wrong)) - points, axis=1)
    found = jf.LocalFeet().feet(surface, points, (*wrong, away, ~lost), at_feet=True)
    rounding = 1e4 * np.finfo(points.dtype).eps
    np.testing.assert_allclose(found[2], 0.0, atol=rounding)
    np.testing.assert_allclose(found[0], u, atol=rounding)
    assert np.asarray(found[3]).all()
    assert away.max() > 0.1
