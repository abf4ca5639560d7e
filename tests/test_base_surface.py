"""The base surface follows its boundary: any order, unit, sampling and shape of it."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree

import jaxfit as jf
from jaxfit._base import Boundary, base_surface

SIDES = ("v0", "v1", "u0", "u1")


def sides(surface, count=20001):
    """Points along the four sides, by SciPy: nothing is compiled for each new size of net."""
    net, (K, L) = np.asarray(surface.control_points, float), surface.order
    u, v = (np.asarray(x, float) for x in (surface.knots_u, surface.knots_v))
    curves = {"v0": (u, net[:, 0], K), "v1": (u, net[:, -1], K)}
    curves |= {"u0": (v, net[0], L), "u1": (v, net[-1], L)}
    fine = np.linspace(0, 1, count)
    return {name: BSpline(t, c, k - 1)(fine) for name, (t, c, k) in curves.items()}


def errors(surface, boundary):
    """Distances of the polyline vertices from the side they belong to, one array a side."""
    lines = {name: np.asarray(getattr(boundary, name), float) for name in SIDES}
    size = helpers.diagonal(np.concatenate(list(lines.values())))
    return [cKDTree(c).query(lines[name])[0] / size for name, c in sides(surface).items()]


def assert_follows(surface, boundary, average, maximum):
    for distances in errors(surface, boundary):
        assert distances.mean() < average
        assert distances.max() < maximum


def wavy_boundary(scale=1.0, offset=0.0):
    return Boundary.from_grid(scale * helpers.wavy_grid(41, 31) + offset)


def hairpin(radius=0.01):
    """Out along a straight line, back beside it round a small half circle; extruded."""
    angle = np.linspace(0, np.pi, 100)
    out = np.stack([np.linspace(1, 0, 200), np.full(200, radius)], axis=1)
    turn = radius * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    line = np.concatenate([out, turn, out[::-1] * [1, -1]])
    v0, v1 = (np.pad(line, [(0, 0), (0, 1)], constant_values=z) for z in (0.0, 1.0))
    return Boundary(v0, v1, np.stack([v0[0], v1[0]]), np.stack([v0[-1], v1[-1]]))


@pytest.mark.float32_too
def test_sides_follow_the_boundary_with_few_control_points():
    boundary = wavy_boundary()
    surface = base_surface(boundary)
    assert surface.order == (4, 4)
    assert max(surface.shape) <= 8
    assert surface.control_points.dtype == boundary.v0.dtype
    assert_follows(surface, boundary, 1e-3, 2e-3)
    corners = surface.grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    np.testing.assert_array_equal(corners[0, 0], boundary.v0[0])
    np.testing.assert_array_equal(corners[1, 0], boundary.v0[-1])
    np.testing.assert_array_equal(corners[0, 1], boundary.v1[0])
    np.testing.assert_array_equal(corners[1, 1], boundary.v1[-1])


@pytest.mark.float32_too
@pytest.mark.parametrize("net", [(4, 4), (11, 9), (50, 35)])
def test_a_given_net_is_met_exactly(net):
    surface = base_surface(wavy_boundary(), net=net)
    assert surface.shape == net
    assert_follows(surface, wavy_boundary(), 1e-3, 3e-3)
    assert (np.diff(np.unique(surface.knots_u)) > 1e-3).all()


def test_one_order_is_that_of_both_directions():
    one, both = (base_surface(wavy_boundary(), net=(9, 10), order=order) for order in (3, (3, 3)))
    assert one.order == both.order == (3, 3)
    np.testing.assert_array_equal(one.control_points, both.control_points)


def test_lowest_and_highest_order():
    surface = base_surface(wavy_boundary(), net=(9, 10), order=(2, 8))
    assert surface.order == (2, 8)
    assert_follows(surface, wavy_boundary(), 1e-3, 2e-3)


def test_a_plane_comes_back_as_that_plane():
    x, y = np.meshgrid(np.linspace(0, 1, 30) ** 2, np.linspace(0, 1, 20), indexing="ij")
    grid = np.stack([x + 0.2 * np.sin(3 * y), y, 2 * x + 0.4 * np.sin(3 * y) - y], axis=-1)
    points = np.asarray(base_surface(Boundary.from_grid(grid)).control_points)
    np.testing.assert_allclose(points @ [2.0, -1.0, -1.0], 0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("scale", "offset"), [(1e-25, 0.0), (1e25, 0.0), (700.0, np.array([5.1e5, 5.4e6, 0.0]))]
)
def test_units_and_millions_do_not_matter(scale, offset):
    moved = base_surface(wavy_boundary(scale, offset)).control_points
    expected = base_surface(wavy_boundary()).control_points
    np.testing.assert_allclose((np.asarray(moved) - offset) / scale, expected, atol=1e-8)


@pytest.mark.float32_too
def test_a_hairpin_makes_no_loop():
    surface = base_surface(hairpin())
    assert_follows(surface, hairpin(), 2e-3, 5e-3)
    tangents = np.diff(sides(surface)["v0"], axis=0)
    turning = np.abs(np.diff(np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0])))).sum()
    assert turning < 1.1 * np.pi  # a half turn and hardly a wiggle
    assert np.linalg.norm(tangents, axis=1).sum() < 2.05


def test_uneven_sampling_and_long_edges_still_fit():
    s = np.linspace(0, 1, 200) ** 6  # a crowd of vertices at one end, long edges at the other
    x, y = np.meshgrid(s, s, indexing="ij")
    grid = np.stack([x, y, 0.1 * np.sin(3 * x + 0.5) * np.cos(2.5 * y)], axis=-1)
    boundary = Boundary.from_grid(grid)
    assert_follows(base_surface(boundary), boundary, 1e-3, 2e-3)
    assert_follows(base_surface(boundary, net=(12, 11)), boundary, 1e-3, 2e-3)


def test_four_straight_edges_of_two_vertices():
    grid = np.stack(np.meshgrid([0.0, 2.0], [0.0, 1.0], indexing="ij"), axis=-1)
    surface = base_surface(Boundary.from_grid(np.pad(grid, [(0, 0), (0, 0), (0, 1)])))
    assert surface.shape == (4, 4)
    np.testing.assert_allclose(surface(0.5, 0.5), [1.0, 0.5, 0.0], atol=1e-15)


def test_a_tube_closes():
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 61), np.linspace(0, 3, 20), indexing="ij")
    grid = np.stack([np.cos(angle), np.sin(angle), z], axis=-1)
    grid[-1] = grid[0]
    boundary = Boundary.from_grid(grid)
    surface = base_surface(boundary)
    assert_follows(surface, boundary, 1e-3, 2e-3)
    np.testing.assert_array_equal(surface.control_points[0], surface.control_points[-1])


def test_the_cloud_only_sets_the_scale_of_the_tolerance():
    boundary = wavy_boundary()
    far = np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
    coarse, fine = (base_surface(boundary, points, tolerance=5e-4).shape for points in (far, None))
    assert all(few < many for few, many in zip(coarse, fine, strict=True))


def test_a_second_boundary_compiles_nothing():
    base_surface(wavy_boundary(), net=(11, 9))
    other = Boundary.from_grid(helpers.wavy_grid(57, 23, height=0.2))
    with helpers.count_compilations() as compiled:
        base_surface(other, net=(11, 9))
    assert compiled.count == 0


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"net": (3, 9)}, "net must be at least 4 x 4"),
        ({"net": (9, 4), "order": (4, 5)}, "net must be at least 4 x 5"),
        ({"order": (1, 4)}, "order must be a whole number from 2 to 8, or a pair"),
        ({"order": 9}, "order must be a whole number from 2 to 8, or a pair"),
        ({"order": (4, 9)}, "order must be a whole number from 2 to 8, or a pair"),
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"points": np.ones((5, 2))}, "points must have 3 coordinates"),
    ],
)
def test_impossible_requests_are_refused(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        base_surface(wavy_boundary(), **arguments)


def test_inside_jit_it_says_so():
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(base_surface)(wavy_boundary())


@pytest.mark.parametrize("method", [None, jf.Coons(), jf.Meshless()])
def test_traced_points_are_refused_with_what_is_possible(method):
    boundary, points = wavy_boundary(), np.random.default_rng(0).random((80, 3))
    with pytest.raises(TypeError, match=r"points must be concrete.*approximate\(points, base\)"):
        jax.jit(lambda x: base_surface(boundary, x, method=method))(points)
    with pytest.raises(TypeError, match=r"must be concrete.*approximate\(points, base\)"):
        jax.jit(lambda x: jf.fit_points(x, boundary, base=method).average_error)(points)


def test_nets_not_asked_for_follow_one_rule():
    boundary = Boundary.from_grid(helpers.wavy_grid(9, 9) * [4.0, 1.0, 1.0])
    points = np.random.default_rng(0).random((800, 3)) * [4.0, 1.0, 0.0]
    assert base_surface(boundary, points, method=jf.Meshless()).shape == (20, 8)
    quick = dict(method=jf.GeometricApproximation(), max_steps=0)  # whose program is the smallest
    assert jf.fit_points(points, boundary, **quick).surface.shape == (20, 8)


def real_boundary(name):
    arrays = helpers.data(name)
    if "grid" in arrays:
        return Boundary.from_grid(arrays["grid"])
    return Boundary(*(arrays[f"boundary_{side}"] for side in SIDES))


# Bounds: 1.5 to 2 times what the worst of the four sides measured, as fractions of the diagonal.
@pytest.mark.parametrize(
    ("name", "coarse", "net", "fine"),
    [
        ("blade_wrap_3000", (5e-4, 3e-3), (24, 40), (3e-4, 1.5e-3)),
        ("mannequin_head", (8e-4, 2e-3), (42, 42), (2.5e-4, 8e-4)),
        ("igea_face", (1.5e-3, 6e-3), (42, 42), (3e-4, 1.6e-3)),
        ("mountain", (3e-3, 1.5e-2), (42, 42), (3.5e-4, 1.5e-3)),
        ("jacksboro_dem", (2.5e-3, 8e-3), (42, 42), (4e-4, 2.5e-3)),
    ],
)
def test_outlines_of_real_scans(name, coarse, net, fine):
    boundary = real_boundary(name)
    surface = base_surface(boundary)
    assert max(surface.shape) < 30
    assert_follows(surface, boundary, *coarse)
    surface = base_surface(boundary, net=net)
    assert surface.shape == net
    assert_follows(surface, boundary, *fine)
    assert jnp.isfinite(surface.control_points).all()
