"""Meshless parameters keep shapes whatever the density; the base at them is near any cloud."""

import warnings

import helpers
import jax
import numpy as np
import pytest
from scipy.spatial import Delaunay

import jaxfit as jf
from jaxfit._base import _delaunay_stars
from jaxfit._base._delaunay_stars import mean_value_weights, stars

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
NET = (10, 9)


def square(lift=lambda x: x):
    """Boundary of two vertices a side."""
    a, b, c, d = lift(SQUARE)
    return jf.Boundary(np.stack([a, b]), np.stack([d, c]), np.stack([a, d]), np.stack([b, c]))


def uneven(count, seed=0):
    """Points of the unit square, eight times as dense on the left as on the right."""
    x, y = np.random.default_rng(seed).random((2, count))
    return np.stack([np.where(x < 8 / 9, x * 9 / 16, 0.5 + (x - 8 / 9) * 4.5), y], axis=1)


def bump(count=1500, seed=0):
    points, edges = helpers.wavy_cloud(count, seed, 0.4)
    return points, jf.Boundary(**edges)


def nets(points, boundary, **options):
    surface = jf.base_surface(boundary, points, NET, method=jf.Meshless(**options))
    return np.asarray(surface.control_points)


def mean_error(surface, points):
    """Mean distance over the diagonal."""
    return helpers.mean_distance(surface, points) / helpers.diagonal(points)


def test_stars_are_those_of_the_delaunay_triangulation():
    points = np.random.default_rng(0).random((800, 2))
    star = stars(points, 30)
    first, others = Delaunay(points).vertex_neighbor_vertices
    inner = np.flatnonzero(np.all(np.abs(points - 0.5) < 0.4, axis=1))
    for i in inner:
        assert set(star.members[i][star.filled[i]]) == set(others[first[i] : first[i + 1]])
    inner = inner[star.angle[inner].max(axis=1) < np.deg2rad(150)]  # where nothing is capped
    weights = mean_value_weights(star)
    means = np.sum(weights[..., None] * points[star.members], axis=1) / weights.sum(axis=1)[:, None]
    np.testing.assert_allclose(means[inner], points[inner], atol=1e-12)


def test_gaps_between_scan_lines_take_no_search_among_all_points(monkeypatch):
    x, y = np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 1, 20), indexing="ij")
    points = np.stack([x, y], axis=2).reshape(-1, 2)
    points = points + np.random.default_rng(0).normal(0, [1e-4, 2e-3], points.shape)
    entries, search = [], _delaunay_stars._stars_among

    def counted(planes, rows, members, filled, straight):
        entries.append(members.size)
        return search(planes, rows, members, filled, straight)

    monkeypatch.setattr(_delaunay_stars, "_stars_among", counted)
    star = stars(points, 16)
    assert sum(entries) < 200 * len(points)
    inner = np.all(np.abs(points - 0.5) < 0.42, axis=1)
    assert (star.angle[inner].max(axis=1) < np.pi).mean() > 0.99


def test_a_flat_square_keeps_its_coordinates_at_eight_to_one_density():
    points = uneven(3000)
    u, v = jf.meshless_parameters(points, square(), reweightings=0)
    np.testing.assert_allclose(u, points[:, 0], atol=0.02)
    np.testing.assert_allclose(v, points[:, 1], atol=0.02)


def test_a_hole_keeps_its_size_and_the_surface_goes_on_across_it():
    points = np.random.default_rng(3).random((1200, 2))
    holed = points[np.hypot(*(points - 0.5).T) > 0.3]
    u, v = jf.meshless_parameters(holed, square(), reweightings=0)
    np.testing.assert_allclose(u, holed[:, 0], atol=0.02)
    np.testing.assert_allclose(v, holed[:, 1], atol=0.02)
    cloud, boundary = bump(1500)
    cloud = cloud[np.hypot(cloud[:, 0] - 0.5, cloud[:, 1] - 0.5) > 0.3]
    surface = jf.base_surface(boundary, cloud, NET, method=jf.Meshless())
    s = np.linspace(0, 1, 60)
    up = np.asarray(surface.normal(*np.meshgrid(s, s, indexing="ij")))[..., 2]
    assert up.min() > 0.2


def test_neighbours_behind_one_another_do_not_depend_on_rounding():
    points = np.stack(np.meshgrid(*2 * [np.arange(9.0)], indexing="ij"), -1).reshape(-1, 2)
    points = points[np.random.default_rng(0).random(len(points)) < 0.8]
    expected = [set(x[f]) for x, f in zip(*stars(points, 20)[:2], strict=True)]
    for angle in (0.3, 1.1, 2.0):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turned = stars(points @ turn.T, 20)
        assert [set(x[f]) for x, f in zip(*turned[:2], strict=True)] == expected


def test_boundary_vertices_and_duplicates_get_what_they_must():
    points, boundary = bump(300)
    u0 = np.asarray(boundary.u0)
    u, v = jf.meshless_parameters(np.concatenate([points, points[:50], u0]), boundary)
    np.testing.assert_array_equal(u[300:350], u[:50])
    np.testing.assert_array_equal(u[350:], 0.0)
    arc = np.cumsum(np.linalg.norm(np.diff(u0, axis=0), axis=1))
    np.testing.assert_allclose(v[351:], arc / arc[-1], atol=1e-12)


@pytest.mark.float32_too
def test_a_boundary_that_has_been_rounded_has_the_same_points_on_it():
    x, y = np.meshgrid(np.linspace(0, 1, 31), np.linspace(0, 1, 29) ** 1.3, indexing="ij")
    grid = np.stack([x, y, 0.3 * np.sin(6 * x) * np.sin(5 * y + 1)], axis=2)
    points, base = grid.reshape(-1, 3), []
    for dtype in (np.float64, np.float32):
        boundary = jf.Boundary.from_grid(grid.astype(dtype))
        base.append(nets(points, boundary).astype(float))
        u, v = jf.meshless_parameters(points, boundary)
        border = (x.ravel() % 1 == 0) | (y.ravel() % 1 == 0)
        assert np.all(((u % 1 == 0) | (v % 1 == 0))[border])
    np.testing.assert_allclose(base[0], base[1], rtol=0, atol=1e-4)


def test_an_overhang_is_carried():
    # A ball cut off below: the height goes up, over and in again, so that sides lie under the top.
    cut = 0.75
    points = np.random.default_rng(1).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points = points[points[:, 2] > -np.cos(cut)]
    turn = np.linspace(0, np.pi / 2, 30)
    sides = []
    for start in (-3, -1, 1, 3):
        angle = start * np.pi / 4 + turn
        height = np.full(30, -np.cos(cut))
        sides.append(np.stack([np.sin(cut) * np.cos(angle), np.sin(cut) * np.sin(angle), height], axis=1))
    boundary = jf.Boundary(v0=sides[0], v1=sides[2][::-1], u0=sides[3][::-1], u1=sides[1])
    base = jf.base_surface(boundary, points, NET, method=jf.Meshless())
    assert mean_error(base, points) < 1e-2
    assert mean_error(jf.base_surface(boundary, net=NET), points) > 0.1


def test_the_border_is_that_of_the_coons_surface():
    points, boundary = bump()
    net, coons = nets(points, boundary), np.asarray(jf.base_surface(boundary, points, NET).control_points)
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        np.testing.assert_allclose(net[edge], coons[edge], atol=1e-15)


def test_without_a_net_it_follows_the_number_of_points():
    points, boundary = bump(800)
    surface = jf.base_surface(boundary, points, method=jf.Meshless())
    assert min(surface.shape) >= 8
    assert max(surface.shape) <= 20
    assert mean_error(surface, points) < 2e-3


def test_order_of_points_and_place_do_not_matter():
    points, boundary = bump(600)
    points = np.concatenate([points, helpers.wavy_grid(12, 12, 0.4).reshape(-1, 3)])  # with ties
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    net = nets(points, boundary)
    np.testing.assert_allclose(nets(rng.permutation(points), boundary), net, atol=1e-10)
    moved = jax.tree.map(lambda x: 300 * x @ turn.T + 1e3, boundary)
    there = (nets(300 * points @ turn.T + 1e3, moved) - 1e3) @ turn / 300
    np.testing.assert_allclose(there, net, atol=1e-9)


def test_how_far_out_control_points_may_lie_does_not_depend_on_the_axes():
    arrays = helpers.data("blade_wrap_3000")
    sides = {key[-2:]: x for key, x in arrays.items() if key.startswith("boundary_")}
    turn = np.array([[np.sqrt(0.75), -0.5, 0.0], [0.5, np.sqrt(0.75), 0.0], [0.0, 0.0, 1.0]])
    found = []
    for turned in (np.eye(3), turn):
        boundary = jf.Boundary(**{name: x @ turned.T for name, x in sides.items()})
        base = jf.base_surface(boundary, arrays["points"] @ turned.T, (16, 16), method=jf.Meshless())
        found.append(np.asarray(base.control_points) @ turned)
    np.testing.assert_allclose(found[1], found[0], atol=1e-9 * helpers.diagonal(arrays["points"]))


def test_coordinates_in_the_millions():
    points, boundary = bump(400)
    far = jax.tree.map(lambda x: x + 5e6, boundary)
    np.testing.assert_allclose(nets(points + 5e6, far) - 5e6, nets(points, boundary), atol=1e-6)


def test_gross_outliers_hardly_pull():
    points, boundary = bump(2000)
    rng = np.random.default_rng(2)
    spoilt = points.copy()
    spoilt[:20] += rng.normal(size=(20, 3))
    surface = jf.base_surface(boundary, spoilt, NET, method=jf.Meshless())
    assert mean_error(surface, points[20:]) < 2e-3


@pytest.mark.parametrize("kind", ["hole", "outside", "two groups", "on a line", "20", "1", "copies"])
def test_poor_clouds_give_finite_surfaces_within_reach(kind):
    points, boundary = bump(600)
    x, y, _ = points.T
    poor = {
        "hole": points[np.hypot(x - 0.5, y - 0.5) > 0.3],
        "outside": points * [2.0, 1.0, 1.0],
        "two groups": points[(np.abs(x - 0.3) < 0.05) | (np.abs(x - 0.7) < 0.02)],
        "on a line": np.linspace([0.1, 0.2, 0.0], [0.9, 0.7, 0.1], 40),
        "20": points[:20],
        "1": points[:1],
        "copies": np.repeat(points[:2], 40, axis=0),
    }[kind]
    net = nets(poor, boundary)
    assert np.isfinite(net).all()
    assert np.abs(net).max() < 4


def test_a_boundary_far_from_the_points_gives_parameters_without_warnings():
    points, edges = helpers.wavy_cloud(600)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        u, v = jf.meshless_parameters(points + np.array([0.0, 0.0, 0.5]), jf.Boundary(**edges))
    assert np.isfinite(np.stack([u, v])).all()


def test_a_cloud_larger_than_asked_for_is_thinned():
    points, boundary = bump(3000)
    surface = jf.base_surface(boundary, points, NET, method=jf.Meshless(most_points=300))
    assert mean_error(surface, points) < 5e-3


@pytest.mark.parametrize("kind", ["noise", "second sheet"])
def test_no_folds_where_points_contradict_each_other(kind):
    points, boundary = bump(2000)
    rng = np.random.default_rng(5)
    if kind == "noise":  # coarser than the points are dense
        given = points + 0.02 / np.sqrt(3) * helpers.diagonal(points) * rng.normal(size=points.shape)
    else:
        below = points[np.hypot(points[:, 0] - 0.5, points[:, 1] - 0.5) < 0.25] - np.array([0.0, 0.0, 0.1])
        given = np.concatenate([points, below])
    surface = jf.base_surface(boundary, given, (24, 24), method=jf.Meshless())
    assert helpers.folds(surface) == 0
    assert mean_error(surface, points) < {"noise": 5e-3, "second sheet": 6e-3}[kind]


@pytest.mark.parametrize(
    ("name", "net", "density", "most", "near"),
    [
        ("mannequin_head", (42, 42), 1.0, 10, 2e-3),
        ("blade_wrap_3000", (24, 40), 1.0, 0, 1.2e-3),
        ("mountain", (42, 42), 50.0, 0, 1.5e-3),
    ],
)
def test_scans_that_overhang_face_themselves_or_thin_out_have_no_folds(name, net, density, most, near):
    arrays = helpers.data(name)
    boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
    points = arrays["points"]
    across = (points[:, 0] - points[:, 0].min()) / np.ptp(points[:, 0])
    kept = points[np.random.default_rng(2).random(len(points)) < density**-across]
    surface = jf.base_surface(boundary, kept, net, method=jf.Meshless())
    assert helpers.folds(surface) <= most
    assert mean_error(surface, points) < near


def test_a_sharp_edge_is_no_fold_to_an_order_of_two():
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 41), np.linspace(0, 1, 41), indexing="ij")
    roof = np.stack([0.6 * x, y, -0.8 * np.abs(x)], axis=2)  # the normal turns by 106 degrees
    boundary, points = jf.Boundary.from_grid(roof), roof[1:-1, 1:-1].reshape(-1, 3)
    surface = jf.base_surface(boundary, points, (15, 15), (2, 2), method=jf.Meshless())
    assert mean_error(surface, points) < 3.2e-3


def test_a_fold_of_the_border_is_left_as_it_is():
    # A side that runs back on itself: whatever the inside does, normals turn over there.
    points, boundary = bump(600)
    v0 = np.asarray(boundary.v0)
    there = np.concatenate([v0[:20], v0[20:10:-1] + np.array([0.0, 0.0, 0.05]), v0[11:]])
    folded = jf.Boundary(there, boundary.v1, boundary.u0, boundary.u1)
    surface = jf.base_surface(folded, points, (24, 24), method=jf.Meshless())
    assert helpers.folds(surface) > 0
    assert mean_error(surface, points) < 2e-2


def test_what_cannot_be_is_refused():
    points, boundary = bump(50)
    with pytest.raises(ValueError, match=r"points must be given for Meshless\(\)"):
        jf.base_surface(boundary, method=jf.Meshless())
    with pytest.raises(ValueError, match="neighbours must be a whole number of at least 6"):
        jf.Meshless(neighbours=3)
    with pytest.raises(ValueError, match="smoothing must be a number of at least 1e-10"):
        jf.Meshless(smoothing=0.0)
    with pytest.raises(ValueError, match="points must have 3 coordinates"):
        jf.meshless_parameters(points[:, :2], boundary)
    with pytest.raises(TypeError, match="must be concrete"):
        jax.jit(lambda x: jf.meshless_parameters(x, boundary))(points)


def test_an_object_names_the_coons_surface():
    _, boundary = bump(10)
    named = jf.base_surface(boundary, net=NET, method=jf.Coons(jf.Uniform()))
    given = jf.base_surface(boundary, net=NET, abscissae=jf.Uniform())
    np.testing.assert_array_equal(named.control_points, given.control_points)


def test_fits_take_it_where_the_blend_of_the_sides_is_far_away():
    x, y = np.random.default_rng(4).random((2, 800))
    dome = np.stack([x, y, 3.0 * x * (1 - x) * y * (1 - y)], axis=1)
    t = np.linspace(0.0, 1.0, 20)
    flat = np.zeros_like(t)
    sides = ((t, flat), (t, flat + 1.0), (flat, t), (flat + 1.0, t))
    boundary = jf.Boundary(*(np.stack([*xy, flat], axis=1) for xy in sides))
    options = dict(net=(10, 10), method=jf.GeometricApproximation(), tol_average=0.0, max_steps=0)
    blended = jf.fit_points(dome, boundary, base=jf.Coons(), **options)
    chosen = jf.fit_points(dome, boundary, **options)
    assert float(chosen.average_error) < 0.05 * float(blended.average_error)
    near = jf.fit_points(dome * [1.0, 1.0, 1e-2], boundary, **options)
    coons = jf.base_surface(boundary, dome, net=(10, 10))
    assert (np.asarray(near.surface.control_points) == np.asarray(coons.control_points)).all()
