"""A Boundary has common corners, no repeats, and says in one sentence what is wrong with it."""

import helpers
import jax
import numpy as np
import pytest

import jaxfit as jf
from jaxfit._base import Boundary, far_sides


def square(n=5):
    """Four sides of the unit square in space, n vertices each."""
    s = np.linspace(0, 1, n)
    o, i = np.zeros(n), np.ones(n)
    sides = {"v0": (s, o), "v1": (s, i), "u0": (o, s), "u1": (i, s)}
    return {name: np.stack([*xy, xy[0] * xy[1]], axis=1) for name, xy in sides.items()}


@pytest.mark.float32_too
def test_edges_of_a_grid_are_taken_in_the_documented_order():
    grid = helpers.wavy_grid(5, 4)
    boundary = Boundary.from_grid(grid)
    for name, edge in helpers.grid_edges(grid).items():
        np.testing.assert_allclose(getattr(boundary, name), edge, rtol=helpers.eps())


def test_nearly_common_corners_become_common():
    sides = square()
    sides["u1"][0] += 1e-7
    boundary = Boundary(**sides)
    np.testing.assert_array_equal(boundary.u1[0], boundary.v0[-1])
    with pytest.raises(ValueError, match="do not meet"):
        Boundary(**sides, tolerance=1e-9)


@pytest.mark.float32_too
def test_consecutive_duplicates_are_dropped_and_both_ends_stay():
    sides = square()
    sides["v0"] = np.repeat(sides["v0"], [3, 1, 2, 1, 4], axis=0)
    assert Boundary(**sides).v0.shape == (5, 3)
    np.testing.assert_array_equal(Boundary(**sides).v0, Boundary(**square()).v0)


def test_a_gap_is_reported_with_its_place_and_size():
    sides = square()
    sides["u1"] = sides["u1"] + np.array([0.0, 0.0, 0.5])
    sentence = r"end of v0 and the start of u1 are 0.5 apart \(24.3 % .*share their corner points"
    with pytest.raises(ValueError, match=sentence):
        Boundary(**sides)


def test_corners_that_nearly_meet_are_joined_by_the_tolerance_that_is_named():
    sides = square()
    sides["u1"] = sides["u1"] + np.array([0.0, 0.0, 1e-3])
    with pytest.raises(ValueError, match=r"pass tolerance=\S+ to Boundary to join them") as caught:
        Boundary(**sides)
    tolerance = float(str(caught.value).split("tolerance=")[1].split()[0])
    assert 5.7e-4 < tolerance < 7e-4
    np.testing.assert_array_equal(Boundary(**sides, tolerance=tolerance).u1[0], sides["v0"][-1])


def test_reversed_polylines_that_nearly_meet_are_named_first():
    sides = square()
    sides["v1"] = sides["v1"][::-1]
    sides["u1"] = sides["u1"] + np.array([0.0, 0.0, 1e-3])
    with pytest.raises(ValueError, match="reverse v1"):
        Boundary(**sides)


@pytest.mark.parametrize("turned", [("v1",), ("u0", "u1")])
def test_a_reversed_polyline_is_named(turned):
    sides = square()
    for name in turned:
        sides[name] = sides[name][::-1]
    with pytest.raises(ValueError, match=f"reverse {' and '.join(turned)}"):
        Boundary(**sides)


def test_sides_in_the_order_of_a_walk_round_the_patch_are_told_the_right_order():
    v0, v1, u0, u1 = square().values()
    with pytest.raises(ValueError, match=r"\(100 % .*give them as Boundary\(v0, v1, u0, u1\)"):
        Boundary(v0, u1, v1[::-1], u0[::-1], tolerance=0.1)


@pytest.mark.parametrize(
    ("name", "line", "sentence"),
    [
        ("v1", np.ones((1, 3)), "v1 must hold at least 2 points"),
        ("u0", np.full((4, 3), np.inf), "u0 must be finite"),
        ("u1", np.ones((4, 2)), "u1 has 2 coordinates a vertex and v0 has 3"),
        ("v0", np.ones((4, 3)), "v0 has length zero"),
        ("u0", np.ones(4), "u0 must have 2 dimensions"),
    ],
)
def test_impossible_polylines_are_refused(name, line, sentence):
    with pytest.raises(ValueError, match=sentence):
        Boundary(**{**square(), name: line})


def test_a_side_that_the_shared_corners_shrink_to_a_point_is_refused():
    sides = square()
    sides["v1"] = np.linspace(sides["v0"][0], sides["v1"][-1], 7)
    sides["u0"] = np.stack([sides["v0"][0], sides["v0"][0] + 1e-8])
    with pytest.raises(ValueError, match="u0 has length zero"):
        Boundary(**sides)


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_sides_on_one_line_are_refused_and_a_thin_strip_is_not(offset):
    def side(a, b, rise=0.0):
        place = np.linspace(a, b, 5)[:, None]
        return offset + place * [1.0, 2.0, -0.5] + [0.0, rise, 0.0]

    with pytest.raises(ValueError, match="v0, v1, u0 and u1 all lie on one line"):
        Boundary(side(0, 0.4), side(0.6, 1), side(0, 0.6), side(0.4, 1))
    strip = np.stack([side(0, 1), side(0, 1, 1e-6)], axis=1)
    assert Boundary.from_grid(strip).v0.shape == (5, 3)


def test_a_grid_of_one_row_is_refused():
    with pytest.raises(ValueError, match="at least 2 x 2"):
        Boundary.from_grid(np.ones((1, 5, 3)))


def test_a_closed_side_is_accepted():
    angle = np.linspace(0, 2 * np.pi, 9)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring[-1] = ring[0]
    tube = np.stack([np.pad(ring, [(0, 0), (0, 1)], constant_values=z) for z in (0.0, 1.0)], axis=1)
    boundary = Boundary.from_grid(tube)
    np.testing.assert_array_equal(boundary.v0[0], boundary.v0[-1])


def test_a_boundary_goes_through_jit_and_is_built_inside():
    sides = {name: jax.numpy.asarray(x) for name, x in square().items()}
    boundary = jax.jit(lambda **kw: Boundary(**kw))(**sides)
    np.testing.assert_array_equal(jax.jit(lambda b: 2 * b.v1)(boundary), 2 * sides["v1"])


@pytest.mark.parametrize("tolerance", [-1, float("nan"), float("inf"), True])
def test_a_tolerance_that_is_no_distance_is_refused(tolerance):
    with pytest.raises((TypeError, ValueError), match="tolerance must be"):
        Boundary(**square(), tolerance=tolerance)


def test_masked_polylines_are_refused():
    sides = square()
    sides["v1"] = np.ma.masked_greater(sides["v1"], 0.9)
    with pytest.raises(ValueError, match="v1 must not be masked"):
        Boundary(**sides)


def test_sides_that_are_not_where_the_points_are_are_told():
    points, edges = helpers.wavy_cloud(600)
    boundary = Boundary(**edges)
    assert far_sides(points, boundary, 6e-4) == {}
    assert far_sides(np.repeat(points[::6], 6, axis=0), boundary, 0.0) == {}
    below = far_sides(points + np.array([0.0, 0.0, 0.5]), boundary, 6e-4)
    assert list(below) == ["v0", "v1", "u0", "u1"]
    assert all(0.2 < x < 0.4 for x in below.values())
    assert far_sides(points + np.array([0.0, 0.0, 0.5]), boundary, 0.1) == {}  # less than what may be missed
    far = far_sides(points[points[:, 1] > 0.4], boundary, 6e-4)
    assert list(far) == ["v0"]
    x, y = np.meshgrid(np.linspace(0.05, 0.95, 10), np.linspace(0, 1, 100), indexing="ij")
    lines = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3)  # ten times as far apart as their points
    frame = helpers.grid_edges(np.pad(lines.reshape(10, 100, 3), ((1, 1), (0, 0), (0, 0)), mode="edge"))
    frame["u0"][:, 0], frame["u1"][:, 0] = -0.05, 1.05
    for name in ("v0", "v1"):
        frame[name][[0, -1], 0] = -0.05, 1.05
    assert far_sides(lines, Boundary(**frame), 0.0) == {}


def test_a_fit_names_the_sides_that_are_far_from_its_points():
    points, edges = helpers.wavy_cloud(100)
    boundary, method = Boundary(**edges), jf.GeometricApproximation()
    options = dict(net=(6, 5), base=jf.Coons(), max_steps=0, tol_average=1.0)
    fit = jf.fit_points(points + np.array([0.0, 0.0, 0.9]), boundary, method=method, **options)
    assert fit.stats["far_sides"] == {}  # the tolerance is as wide
    fit = jf.fit_points(
        points + np.array([0.0, 0.0, 0.9]), boundary, method=method, **(options | {"tol_average": 1e-3})
    )
    assert "% of the diagonal away from sides v0, v1, u0 and u1 of the boundary" in fit.message
