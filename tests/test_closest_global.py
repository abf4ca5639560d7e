"""Without a start the foot found is the nearest of all."""

import closest_reference
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit import BSplineCurve, BSplineSurface, HuWallner, Newton, PointStatus, closest_point
from jaxfit._closest import _candidates, _chunks, _surface_search, nearest_feet, starting_feet
from jaxfit._closest._candidates import Search
from jaxfit._splines._pieces import make_axis

COUNT = 512  # one size for nearly all queries: few compilations


def queries(surface, count=COUNT, seed=0):
    """Points 1 to 5 % of the diagonal off the surface, on both sides, and where they came from."""
    rng = np.random.default_rng(seed)
    (a, b), (c, d) = np.asarray(surface.domain)
    u, v = rng.uniform(a, b, count), rng.uniform(c, d, count)
    height = rng.choice([-1, 1], count) * rng.uniform(0.01, 0.05, count)
    height *= helpers.diagonal(surface.control_points)
    return np.asarray(surface(u, v)) + height[:, None] * np.asarray(surface.normal(u, v)), u, v


def assert_nearest(spline, points, tolerance=1e-9, **options):
    feet = closest_point(spline, points, **options)
    net = np.asarray(spline.control_points).reshape(-1, points.shape[1])
    size = helpers.diagonal(np.concatenate([points, net]))
    surface = closest_reference.ruled(spline) if isinstance(spline, BSplineCurve) else spline
    expected = closest_reference.nearest_distance(surface, points)
    assert feet.converged.all()
    assert np.max(np.asarray(feet.distance) - expected) <= tolerance * size
    at = spline(feet.u) if feet.v is None else spline(feet.u, feet.v)
    rounding = 1e-12 * size + 8 * helpers.eps() * np.abs(points).max()
    np.testing.assert_allclose(feet.point, at, rtol=0, atol=rounding)
    away = np.linalg.norm(points - at, axis=1)
    np.testing.assert_allclose(feet.distance, away, rtol=0, atol=2 * rounding)
    return feet


@pytest.fixture(scope="module")
def wavy():
    net = helpers.wavy_net(16, 14, height=0.3)
    return BSplineSurface(net, helpers.clamped_uniform(16, 4), helpers.clamped_uniform(14, 4))


def test_feet_of_points_off_a_wavy_surface_are_nearest(wavy):
    points, _, _ = queries(wavy)
    feet = assert_nearest(wavy, points)
    circle = closest_point(wavy, points, method=HuWallner())
    assert circle.converged.all()
    np.testing.assert_allclose(circle.distance, feet.distance, rtol=0, atol=1e-12)


def test_feet_of_points_far_away_and_all_around_are_nearest(wavy):
    far = np.random.default_rng(1).uniform(-3, 4, (COUNT, 3))
    feet = assert_nearest(wavy, far)
    status, u, v = (np.asarray(x) for x in (feet.status, feet.u, feet.v))
    on_sides = ((u == 0) | (u == 1)).astype(int) + ((v == 0) | (v == 1))
    np.testing.assert_array_equal(status, on_sides)
    assert {PointStatus.INTERIOR, PointStatus.BORDER, PointStatus.CORNER} == set(status.tolist())
    assert (np.asarray(feet.steps) > 0).all()


def test_points_in_rows_get_the_feet_of_points_in_blocks(wavy):
    points, _, _ = queries(wavy, 4608)
    rows, blocks = closest_point(wavy, points), closest_point(wavy, points[:COUNT])
    assert rows.converged.all()
    for name in ("u", "v", "distance"):
        np.testing.assert_allclose(getattr(rows, name)[:COUNT], getattr(blocks, name), atol=1e-9)
    assert np.max(np.asarray(rows.distance[:COUNT] - blocks.distance)) <= 1e-12


def test_a_cloud_in_chunks_has_the_feet_of_the_whole(wavy, monkeypatch):
    points, u, v = queries(wavy)
    start = (np.clip(u + 0.01, 0, 1), np.clip(v - 0.01, 0, 1))
    whole, warm = closest_point(wavy, points), closest_point(wavy, points, start)
    monkeypatch.setattr(_chunks, "CHUNK", COUNT // 2 - 50)  # three parts, the last one shorter
    for feet, expected in ((closest_point(wavy, points), whole), (closest_point(wavy, points, start), warm)):
        assert feet.converged.all()
        np.testing.assert_allclose(feet.distance, expected.distance, rtol=0, atol=1e-12)
        np.testing.assert_allclose(feet.point, expected.point, rtol=0, atol=1e-9)


def test_candidates_are_tried_for_a_few_points_at_a_time(wavy, monkeypatch):
    points, _, _ = queries(wavy)
    whole, counts, candidates = closest_point(wavy, points), [], Search.candidates
    monkeypatch.setattr(_surface_search, "MOST_POINTS", 50)

    def counted(search, some, *feet):
        counts.append(len(some))
        return candidates(search, some, *feet)

    monkeypatch.setattr(Search, "candidates", counted)
    feet = closest_point(wavy, points)
    assert len(counts) > 2
    assert max(counts) == 50
    np.testing.assert_allclose(feet.distance, whole.distance, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["blade_wrap_3000", "mannequin_head"])
def test_feet_on_folded_base_surfaces_of_scans_are_nearest(name):
    from jaxfit._base import Boundary, base_surface

    data = helpers.data(name)
    sides = Boundary(*(data[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
    net = (24, 40) if name == "blade_wrap_3000" else (42, 42)
    base = base_surface(sides, data["points"], net=net)
    near, _, _ = queries(base, COUNT // 2)
    assert_nearest(
        base, np.concatenate([data["points"][:: len(data["points"]) // (COUNT // 2)], near])[:COUNT]
    )


def test_creases_do_not_stop_the_search():
    # Order 2 along u; along v order 3, a double knot, and a triple one across which nothing jumps.
    net = helpers.wavy_net(9, 10, height=0.3)
    net[:, 6] = net[:, 5]
    knots_v = np.array([0, 0, 0, 0.2, 0.4, 0.4, 0.7, 0.7, 0.7, 0.9, 1, 1, 1])
    surface = BSplineSurface(net, helpers.clamped_uniform(9, 2), knots_v)
    assert_nearest(surface, np.random.default_rng(0).uniform(-0.3, 1.3, (COUNT, 3)))


@pytest.mark.float32_too
@pytest.mark.parametrize("seed", range(3))
def test_creases_do_not_stop_the_search_in_single_precision(seed):
    rng = np.random.default_rng(seed)
    knots = helpers.clamped_uniform(8, 2)
    surface = BSplineSurface(*(np.asarray(x, np.float32) for x in (helpers.wavy_net(8, 8), knots, knots)))
    feet = closest_point(surface, rng.uniform(-0.2, 1.2, (5000, 3)).astype(np.float32))
    assert feet.converged.all()


def test_a_closed_surface_has_feet_on_both_sides_of_its_seam():
    angle = np.linspace(0, 2 * np.pi, 16)
    x, y = 1.0 / np.cos(np.pi / 15) * np.stack([np.cos(angle), np.sin(angle)])
    net = np.stack([np.stack([x, y, np.full(16, z)], -1) for z in np.linspace(0, 2, 14)], 1)
    surface = BSplineSurface(net, helpers.clamped_uniform(16, 4), helpers.clamped_uniform(14, 4))
    rng = np.random.default_rng(2)
    spread = rng.normal(size=COUNT) * 0.05
    points = np.stack([rng.uniform(0.8, 1.5, COUNT), spread, rng.uniform(0, 2, COUNT)], -1)
    feet = assert_nearest(surface, points)
    assert (np.asarray(feet.u) < 0.1).any()
    assert (np.asarray(feet.u) > 0.9).any()


def test_a_pole_has_feet_and_no_nan():
    net = helpers.wavy_net(16, 14)
    net[:, 0] = [0.5, -0.2, 0.3]
    surface = BSplineSurface(net, helpers.clamped_uniform(16, 4), helpers.clamped_uniform(14, 4))
    points = np.array([0.5, -0.2, 0.3]) + 0.2 * np.random.default_rng(0).normal(size=(COUNT, 3))
    points[0] = [0.5, -0.2, 0.3]
    feet = closest_point(surface, points)
    assert np.isfinite(np.asarray(feet.point)).all()
    assert np.asarray(feet.converged).all()
    worse = np.asarray(feet.distance) - closest_reference.nearest_distance(surface, points)
    # Samples crowd together at the pole, and the search may then overlook a foot elsewhere.
    assert np.mean(worse > 1e-9) < 0.005


@pytest.mark.parametrize("d", [2, 5])
def test_any_dimension(d):
    rng = np.random.default_rng(d)
    net = np.concatenate([helpers.wavy_net(7, 6), 0.2 * rng.normal(size=(7, 6, 2))], axis=-1)
    surface = BSplineSurface(net[..., :d], helpers.clamped_uniform(7, 4), helpers.clamped_uniform(6, 4))
    points = rng.uniform(-0.2, 1.2, (COUNT, d))
    assert_nearest(surface, points)


@pytest.mark.parametrize("order", [2, 4])
def test_curves(order):
    rng = np.random.default_rng(order)
    curve = BSplineCurve(rng.uniform(size=(12, 2)), helpers.clamped_uniform(12, order))
    feet = assert_nearest(curve, rng.uniform(-0.3, 1.3, (COUNT, 2)))
    assert feet.v is None


def test_a_long_thin_surface_and_coordinates_in_the_millions(wavy):
    thin = wavy.affine(np.diag([50.0, 1.0, 1.0]))
    assert_nearest(thin, queries(thin)[0])
    moved = wavy.affine(np.diag([300.0, 300.0, 300.0]), np.array([5.1e5, 5.4e6, 100.0]))
    # Only nine digits are left below the diagonal; feet are as good as the coordinates are.
    assert_nearest(moved, queries(moved)[0])


def test_known_feet_give_way_to_nearer_ones(wavy):
    points, _, _ = queries(wavy)
    cold = closest_point(wavy, points)
    axes = [make_axis(np.asarray(knots), 4) for knots in (wavy.knots_u, wavy.knots_v)]
    u, v, distance = (np.array(x) for x in (cold.u, cold.v, cold.distance))
    found = np.arange(COUNT) % 7 > 0
    u[~found], v[~found] = 0.5, 0.5  # not feet
    distance[~found] = np.linalg.norm(points[~found] - np.asarray(wavy(0.5, 0.5)), axis=1)
    feet = nearest_feet(
        Newton(),
        np.asarray(wavy.control_points),
        *axes,
        points,
        known=(u, v, distance, found),
        tolerance=1e-12,
        max_steps=60,
    )
    assert feet["converged"].all()
    np.testing.assert_allclose(feet["distance"], cold.distance, rtol=0, atol=1e-12)


def test_feet_to_start_from_are_nearly_all_near_the_nearest_though_few_are_searched_for(wavy, monkeypatch):
    points = np.random.default_rng(1).uniform(-0.2, 1.2, (8000, 3))
    net = np.asarray(wavy.control_points)
    axes = [make_axis(np.asarray(knots), 4) for knots in (wavy.knots_u, wavy.knots_v)]
    searched, candidates = [], Search.candidates

    def counted(search, points, *found):
        searched.append(len(points))
        return candidates(search, points, *found)

    monkeypatch.setattr(Search, "candidates", counted)
    nearest = nearest_feet(Newton(), net, *axes, points, tolerance=1e-12, max_steps=60)["distance"]
    thorough = sum(searched)
    start = starting_feet(Newton(), net, *axes, points, tolerance=1e-12, max_steps=60)
    assert sum(searched) - thorough < 0.8 * thorough
    farther = np.asarray(closest_point(wavy, points, start=start).distance) > nearest * (1 + 5e-7)
    assert np.mean(farther) < 0.01


def ridged():
    """A ridge along a triple knot."""
    knots, net = np.array([0, 0, 0, 0, 0.3, 0.3, 0.3, 0.6, 1, 1, 1, 1]), helpers.wavy_net(8, 8)
    net[3:5, :, 2] += 0.2
    return BSplineSurface(net, knots, knots)


@pytest.mark.parametrize(("surface_of", "outlier"), [(None, 1.0), (None, 100.0), (ridged, 1.0)])
def test_points_that_far_outnumber_samples_start_together_and_find_the_same_feet(
    wavy, surface_of, outlier, monkeypatch
):
    surface = wavy if surface_of is None else surface_of()
    rng = np.random.default_rng(2)
    u, v = rng.uniform(size=(2, 40_000))
    points = np.asarray(surface(u, v)) + 0.02 * rng.normal(size=(u.size, 3))
    points[::5000] *= outlier
    made, boxes = [], _candidates._boxes
    monkeypatch.setattr(_candidates, "_boxes", lambda *x: made.append(boxes(*x)) or made[-1])
    together = closest_point(surface, points)
    assert len(made) == 1
    assert made[0] is not None
    monkeypatch.setattr(_candidates, "MANY", len(points))
    each = closest_point(surface, points)
    np.testing.assert_allclose(together.distance, each.distance, rtol=1e-9, atol=1e-11)


def test_starts_near_the_feet_give_the_same_feet(wavy):
    points, _, _ = queries(wavy)
    cold = closest_point(wavy, points)
    shift = np.random.default_rng(0).uniform(-0.003, 0.003, (2, COUNT))
    warm = closest_point(wavy, points, start=(cold.u + shift[0], cold.v + shift[1]))
    assert warm.converged.all()
    same = np.isclose(warm.distance, cold.distance, rtol=0, atol=1e-12)
    assert same.mean() > 0.98  # points at a centre of curvature have two feet close together
    assert (np.asarray(warm.distance - cold.distance) > -1e-12).all()


@pytest.mark.parametrize("method", [None, HuWallner()])
@given(st.integers(0, 10_000))
def test_a_foot_is_never_farther_than_its_start(wavy, method, seed):
    rng = np.random.default_rng(seed)
    points, start = rng.uniform(-0.5, 1.5, (64, 3)), rng.uniform(size=(2, 64))
    feet = closest_point(wavy, points, start=tuple(start), method=method, max_steps=20)
    before = np.linalg.norm(points - wavy(*start), axis=1)
    assert (np.asarray(feet.distance) <= before + 1e-14).all()
    u, v = np.asarray(feet.u), np.asarray(feet.v)
    assert ((u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)).all()


def test_a_foot_does_not_stop_where_a_second_step_takes_back_the_first():
    knots = helpers.clamped_uniform(42, 4)
    surface = BSplineSurface(helpers.wavy_net(42, 42), knots, knots)
    point = np.array([[0.9857623191308966, 0.0985346778076581, -0.07209940025004573]])
    start = np.array([0.964044578673147]), np.array([0.06376128790671072])
    found = closest_point(surface, point, start)
    assert bool(found.converged[0])
    assert int(found.steps[0]) < 9
    np.testing.assert_allclose(found.distance, closest_point(surface, point).distance, rtol=1e-12)


def test_too_few_steps_are_reported(wavy):
    points, _, _ = queries(wavy)
    feet = closest_point(wavy, points, start=(np.zeros(COUNT), np.zeros(COUNT)), max_steps=1)
    lost = ~np.asarray(feet.converged)
    assert lost.any()
    np.testing.assert_array_equal(np.asarray(feet.status) == PointStatus.NOT_CONVERGED, lost)
    assert np.isfinite(feet.distance).all()


def test_only_lost_feet_compile_the_search_on_borders():
    surface = helpers.wavy_surface(9, 5)
    points, start = np.random.default_rng(0).uniform(size=(40, 3)), (np.zeros(40), np.zeros(40))
    searches = []
    for steps in (100, 1, 1):
        with helpers.count_compilations() as compiled:
            closest_point(surface, points, start=start, max_steps=steps)
        searches.append(compiled.names.count("jit(_run)"))
    assert searches == [1, 1, 0]


@pytest.mark.float32_too
def test_feet_reach_the_working_precision():
    surface = helpers.wavy_surface(8, 8)
    points, _, _ = queries(surface, 64)
    points = jnp.asarray(points)
    feet = closest_point(surface, points)
    assert feet.converged.all()
    assert feet.distance.dtype == points.dtype
    expected = closest_reference.nearest_distance(surface, np.asarray(points))
    assert np.max(np.asarray(feet.distance) - expected) <= 50 * helpers.eps()


@pytest.mark.parametrize("method", [Newton(), HuWallner()])
@pytest.mark.parametrize("tolerance", [1e-12, 1e-6])
def test_residuals_at_feet_are_orthogonal_to_the_tolerance(method, tolerance):
    rng = np.random.default_rng(1)
    net = helpers.wavy_net(12, 11)
    net[..., 2] += rng.normal(scale=0.15, size=(12, 11))
    surface = BSplineSurface(net, helpers.clamped_uniform(12, 3), helpers.clamped_uniform(11, 5))
    points = rng.uniform((-0.3, -0.3, -0.2), (1.3, 1.3, 0.6), (2000, 3))
    feet = closest_point(surface, points, method=method, tolerance=tolerance)
    assert feet.converged.all()
    inner = np.asarray(feet.status) == PointStatus.INTERIOR
    assert inner.sum() > 500
    away = points - np.asarray(feet.point)
    size = helpers.diagonal(np.concatenate([points, net.reshape(-1, 3)]))
    for order in ((1, 0), (0, 1)):
        tangent = np.asarray(surface.derivative(feet.u, feet.v, *order))
        part = np.sum(away * tangent, axis=1) / np.linalg.norm(tangent, axis=1)
        # A predicted residual may be slightly too small.
        assert np.abs(part[inner]).max() <= 3 * tolerance * size


@pytest.mark.float32_too
def test_a_second_cloud_of_nearby_size_compiles_nothing():
    surface = helpers.wavy_surface(8, 8)
    points, u, v = queries(surface, 64)
    jax.block_until_ready([closest_point(surface, points), closest_point(surface, points, (u, v))])
    with helpers.count_compilations() as compiled:
        closest_point(surface, points[:61])
        closest_point(surface, points[:61], (u[:61], v[:61]), tolerance=1e-4, max_steps=30)
    assert compiled.count == 0
