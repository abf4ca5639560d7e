"""A trimmed surface is the part of its surface inside the loops: membership, area, triangles."""

import dataclasses

import jax
import numpy as np
import pytest
from helpers import diagonal, wavy_grid, wavy_surface

import jaxfit as jf
from jaxfit._trimmed._checked_loops import _common_point
from jaxfit._trimmed._inside import inside_on_grid
from jaxfit._trimmed._trimmed_surface import loop_edges

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
L_SHAPE = np.array([[0.05, 0.05], [0.95, 0.05], [0.95, 0.5], [0.5, 0.5], [0.5, 0.95], [0.05, 0.95]])


def circle(u, v, radius, count=40):
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.array([u, v]) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def frayed(count=300, seed=0):
    """A rim as a scan has it: every vertex at its own distance from the middle."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    radius = 0.42 + 0.02 * np.sin(5 * angle) + np.random.default_rng(seed).uniform(-0.015, 0.015, count)
    return 0.5 + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


HOLES = (circle(0.2, 0.2, 0.1), circle(0.7, 0.3, 0.1))
ON_LINES = np.array([[0.0, 0], [1, 0], [1, 0.5], [0.5, 0.5], [0.5, 1], [0, 1]])
LOOPS = {
    "an L with two holes": (L_SHAPE, *HOLES),
    "frayed": (frayed(),),
    "the whole domain": (SQUARE,),
    "along the border and knots": (ON_LINES, SQUARE * 0.25 + 0.125),
}


def polygon_area(loops):
    x, y = (np.concatenate([loop[:, k] for loop in loops]) for k in (0, 1))
    following = [np.roll(loop, -1, axis=0) for loop in loops]
    xn, yn = (np.concatenate([loop[:, k] for loop in following]) for k in (0, 1))
    return 0.5 * np.sum(x * yn - xn * y)


@pytest.mark.parametrize("which", LOOPS)
def test_points_inside_are_those_of_an_independent_test(which):
    from matplotlib.path import Path

    trimmed = jf.TrimmedSurface(wavy_surface(), LOOPS[which])
    u, v = np.random.default_rng(3).uniform(size=(2, 2000))
    expected = np.logical_xor.reduce([Path(x).contains_points(np.stack([u, v], 1)) for x in LOOPS[which]])
    assert (np.asarray(trimmed.contains(u, v)) == expected).all()
    us, vs = np.sort(u)[::20], np.sort(v)[::20]
    on_grid = inside_on_grid(loop_edges(trimmed), us, vs)
    assert (on_grid == np.asarray(trimmed.contains(us[:, None], vs))).all()


@pytest.mark.float32_too
def test_points_outside_are_nan_and_gradients_finite():
    trimmed = jf.TrimmedSurface(wavy_surface(), LOOPS["an L with two holes"])
    u, v = np.array([0.2, 0.8, 0.4]), np.array([0.2, 0.8, 0.4])
    points = np.asarray(trimmed(u, v))
    assert np.isnan(points[:2]).all()
    np.testing.assert_array_equal(points[2], trimmed.surface(0.4, 0.4))
    slope = jax.jit(jax.grad(lambda t: jax.numpy.nansum(t(u, v))))(trimmed)
    assert np.isfinite(np.asarray(slope.surface.control_points)).all()


@pytest.mark.parametrize("which", LOOPS)
def test_the_area_of_a_flat_sheet_is_that_of_its_polygons(which):
    wavy = wavy_surface(9, 8)
    x, y = np.meshgrid(*wavy.greville(), indexing="ij")
    flat = jf.BSplineSurface(3 * np.stack([x, y, 0 * x], axis=2), wavy.knots_u, wavy.knots_v)
    trimmed = jf.TrimmedSurface(flat, LOOPS[which])
    assert float(trimmed.area()) == pytest.approx(9 * abs(polygon_area(trimmed.loops)), rel=1e-12)


@pytest.mark.parametrize("which", LOOPS)
def test_the_area_of_a_wavy_sheet_is_that_of_many_samples(which):
    surface = wavy_surface(9, 8)
    trimmed = jf.TrimmedSurface(surface, LOOPS[which])
    at = (np.arange(800) + 0.5) / 800
    normals = np.cross(surface.grid(at, at, 1, 0), surface.grid(at, at, 0, 1))
    inside = inside_on_grid(loop_edges(trimmed), at, at)
    assert float(trimmed.area()) == pytest.approx((np.linalg.norm(normals, axis=2) * inside).mean(), rel=3e-4)


def test_the_gradient_of_the_area_is_that_of_finite_differences():
    surface, loops = wavy_surface(), LOOPS["an L with two holes"]

    def area(height):
        net = surface.control_points.at[3, 2, 2].add(height)
        return jf.TrimmedSurface(jf.BSplineSurface(net, surface.knots_u, surface.knots_v), loops).area()

    step = 1e-5
    expected = (area(step) - area(-step)) / (2 * step)
    assert float(jax.grad(area)(0.0)) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.slow
def test_the_gradient_of_the_area_in_the_loops_is_that_of_finite_differences():
    surface = wavy_surface()
    loops = jf.TrimmedSurface(surface, LOOPS["an L with two holes"]).loops
    rng = np.random.default_rng(0)
    moves = [jax.numpy.asarray(rng.normal(size=loop.shape)) for loop in loops]

    def area(share, lift=0.0):
        moved = [loop + share * move for loop, move in zip(loops, moves, strict=True)]
        net = surface.control_points.at[3, 2, 2].add(lift)
        lifted = jf.BSplineSurface(net, surface.knots_u, surface.knots_v)
        return jf.TrimmedSurface(lifted, moved).area()

    step = 1e-6
    slopes = jax.grad(area, argnums=(0, 1))(0.0, 0.0)
    for k, slope in enumerate(slopes):
        ends = [area(*(sign * step * (k == i) for i in (0, 1))) for sign in (1, -1)]
        assert float(slope) == pytest.approx(float(ends[0] - ends[1]) / (2 * step), rel=1e-5)
    with pytest.raises(TypeError, match=r"loops must be known, .*without jit\."):
        jax.jit(area)(0.0)


def test_loops_are_turned_so_that_the_region_is_to_their_left():
    trimmed = jf.TrimmedSurface(wavy_surface(), (SQUARE[::-1], HOLES[0]))
    assert polygon_area(trimmed.loops[:1]) == 1
    assert polygon_area(trimmed.loops[1:]) < 0
    assert trimmed.holes == 1


def test_rings_may_end_where_they_begin():
    rings = [np.concatenate([loop, loop[:1]]) for loop in (SQUARE, HOLES[0])]
    open_, closed = (jf.TrimmedSurface(wavy_surface(), x) for x in ((SQUARE, HOLES[0]), rings))
    for loop, ring in zip(open_.loops, closed.loops, strict=True):
        assert {tuple(x) for x in np.asarray(loop)} == {tuple(x) for x in np.asarray(ring)}
        assert len(loop) == len(ring)


def test_vertices_outside_by_rounding_are_moved_onto_the_border():
    trimmed = jf.TrimmedSurface(wavy_surface(), (SQUARE * (1 + 1e-12) - 5e-13,))
    assert (np.asarray(trimmed.loops[0]) == SQUARE).all()


@pytest.mark.parametrize(
    ("loops", "said"),
    [
        ((), "at least the outer loop"),
        ((SQUARE[:2],), "at least three vertices"),
        ((SQUARE * [1, np.nan],), "must be finite"),
        ((SQUARE * 1.1,), r"must lie in the domain .* \(1\.1, 0\)"),
        ((SQUARE[[0, 1, 1, 2, 3]],), "vertices 1 and 2 are the same"),
        ((SQUARE[[0, 1, 3, 2]],), r"touch or cross itself, but does near \(0\.5, 0\.5\)"),
        (
            (np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.1], [0.5, 0.9]]),),
            r"itself, but does near \(0\.5, 0\.1\)",
        ),
        ((np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.5]]) * [1, 0] + [0, 0.5],), "touch or cross itself"),
        ((L_SHAPE, circle(0.5, 0.5, 0.1)), "touch or cross each other"),
        ((L_SHAPE, circle(0.8, 0.8, 0.1)), r"loops\[1\] is not inside loops\[0\]"),
        ((HOLES[0], SQUARE), r"loops\[1\] is not inside loops\[0\]"),
        ((SQUARE * 0.9 + 0.05, circle(0.5, 0.5, 0.2), circle(0.5, 0.5, 0.1)), "side by side"),
    ],
)
def test_loops_that_bound_no_region_are_refused(loops, said):
    with pytest.raises(ValueError, match=said) as caught:
        jf.TrimmedSurface(wavy_surface(), loops)
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize("angle", np.linspace(0.1, 1.4, 9))
def test_edges_that_lie_on_one_another_are_found_where_they_do(angle):
    along, start = np.array([np.cos(angle), np.sin(angle)]), np.array([0.1, 0.1])
    on_line = start + np.array([0.0, 0.3, 0.1, 0.5])[:, None] * along  # parallel but for rounding
    at = _common_point(on_line[:2], on_line[2:]) - start
    np.testing.assert_allclose(at, np.clip(at @ along, 0.1, 0.3) * along, atol=1e-12)


def test_a_fit_tells_of_folds_only_inside_its_loops():
    grid = np.stack(
        [*np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 1, 7), indexing="ij"), np.zeros((8, 7))], 2
    )
    grid[6] = grid[4] - [0.05, 0, 0]  # folded near the last row
    fit = jf.interpolate(grid, jf.StandardInterpolation())
    assert "the surface folds at" in fit.message
    left = jf.TrimmedSurface(fit.surface, (SQUARE * [0.3, 1],))
    whole = jf.TrimmedSurface(fit.surface, (SQUARE,))
    left, whole = (dataclasses.replace(fit, trimmed=part) for part in (left, whole))
    assert fit.folds == fit.regularity.folds > 0 == left.folds
    assert "folds" not in left.message
    assert f"none inside the loops, {fit.folds:,} cut away" in str(left)
    assert whole.folds > 0
    assert f"the surface folds at {whole.folds:,} places inside its loops: " in whole.message
    assert f"{whole.folds} inside the loops, {fit.folds - whole.folds:,} cut away" in str(whole)


def test_a_fit_tells_its_loops_and_the_errors_inside():
    u, v = np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 1, 7), indexing="ij")
    fit = jf.interpolate(np.stack([u, v, u * v], axis=2), jf.StandardInterpolation())
    assert fit.trimmed is None
    assert np.asarray(fit.inside).all()
    trimmed = jf.TrimmedSurface(fit.surface, LOOPS["an L with two holes"])
    fit = dataclasses.replace(fit, trimmed=trimmed, stats={**fit.stats, "hole_length": 0.25})
    said = str(fit)
    assert fit.message == "all tolerances are met."
    assert "the outer one with 6 vertices, 2 holes (gaps wider than 0.25, the hole length)" in said
    assert f"{int(np.asarray(fit.inside).sum())} of 56 points, average error" in said


def test_many_holes_come_with_what_makes_them_fewer():
    corners = np.array([[0, 0], [0.04, 0], [0.04, 0.04], [0, 0.04]])
    places = np.stack(np.meshgrid(*2 * [np.linspace(0.1, 0.9, 5)]), axis=2).reshape(-1, 2)
    fit = jf.interpolate(wavy_grid(8, 7), jf.StandardInterpolation())
    for count, said in ((20, "the hole length)"), (21, "the hole length; a larger one closes small gaps)")):
        loops = tuple(place + corners[::-1] for place in places[:count])
        trimmed = jf.TrimmedSurface(fit.surface, (SQUARE, *loops))
        stats = {**fit.stats, "hole_length": 0.25}
        shown = str(dataclasses.replace(fit, trimmed=trimmed, stats=stats))
        assert f"{count} holes (gaps wider than 0.25, {said}" in shown


@pytest.mark.parametrize("which", LOOPS)
def test_triangles_fill_the_loops_and_keep_to_the_surface(which):
    trimmed = jf.TrimmedSurface(wavy_surface(9, 8), LOOPS[which])
    vertices, triangles, u, v = trimmed.tessellate(1e-3)
    np.testing.assert_allclose(vertices, trimmed.surface(u, v), atol=1e-12)
    p, q, r = (np.stack([u, v], axis=1)[triangles[:, i]] for i in range(3))
    doubled = (q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0]
    assert (doubled > 0).all()
    assert 0.5 * doubled.sum() == pytest.approx(polygon_area(trimmed.loops), rel=1e-12)
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    sides, counts = np.unique(sides, axis=0, return_counts=True)
    middle = np.asarray(trimmed.surface(*(x[sides].mean(axis=1) for x in (u, v))))
    gap = np.linalg.norm(middle - vertices[sides].mean(axis=1), axis=1)
    assert np.median(gap) <= 1e-3 * diagonal(vertices)
    assert (counts <= 2).all()
    rim = sides[counts == 1]  # which is made of closed polylines
    assert np.bincount(rim.reshape(-1)).max() == 2
    area = 0.5 * np.linalg.norm(
        np.cross(*(vertices[triangles[:, i]] - vertices[triangles[:, 0]] for i in (1, 2))), axis=1
    )
    assert area.sum() == pytest.approx(float(trimmed.area()), rel=2e-3)


@pytest.mark.slow
def test_finer_triangles_come_closer_to_the_area():
    trimmed = jf.TrimmedSurface(wavy_surface(9, 8), (SQUARE, *HOLES))
    errors = []
    for deviation in (1e-3, 1e-5):
        mesh = trimmed.tessellate(deviation)
        corners = mesh.vertices[mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        errors.append(abs(0.5 * np.linalg.norm(normals, axis=1).sum() - float(trimmed.area())))
    assert errors[1] < 0.1 * errors[0]
    assert mesh.triangles.dtype.kind == "i"
    with pytest.raises(ValueError, match=r"deviation must be positive.*\.$"):
        trimmed.tessellate(0.0)


def test_a_loop_closed_but_for_rounding_is_refused():
    angle = np.linspace(0, 2 * np.pi, 41)
    circle = np.stack([0.5 + 0.4 * np.cos(angle), 0.5 + 0.4 * np.sin(angle)], axis=1)
    assert (circle[0] != circle[-1]).any()
    with pytest.raises(ValueError, match="vertices 40 and 0 are the same; remove one"):
        jf.TrimmedSurface(wavy_surface(), (circle,))
