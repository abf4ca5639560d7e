"""The dynamic base surface goes to the cloud, never away from it, and stays finite and in place."""

import helpers
import jax
import numpy as np
import pytest

import jaxfit as jf
from jaxfit._base._directed_projection import directed_projection
from jaxfit._base._host_splines import basis_matrix
from jaxfit._splines._knots import greville

NET = (10, 9)


def bump(count=1500, seed=0):
    """A dome over the unit square; its boundary is flat and says nothing about it."""
    x, y = np.random.default_rng(seed).random((2, count))
    points = np.stack([x, y, 6 * x * (1 - x) * y * (1 - y)], axis=1)
    return points, flat_square()


def flat_square():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    a, b, c, d = (np.asarray(x) for x in corners)
    return jf.Boundary(np.stack([a, b]), np.stack([d, c]), np.stack([a, d]), np.stack([b, c]))


def based(points, boundary, **options):
    return jf.base_surface(boundary, points, NET, method=jf.DynamicBaseSurface(**options))


def mean_error(surface, points):
    """Mean distance over the diagonal."""
    return helpers.mean_distance(surface, points) / helpers.diagonal(points)


def test_a_dome_is_reached_from_its_flat_boundary():
    points, boundary = bump()
    surface = based(points, boundary)
    assert mean_error(surface, points) < 3e-3
    assert mean_error(jf.base_surface(boundary, points, NET), points) > 0.1
    net = np.asarray(surface.control_points)
    assert (np.cross(net[1:, 1:] - net[:-1, :-1], net[:-1, 1:] - net[1:, :-1])[..., 2] > 0).all()


def test_the_border_is_that_of_the_coons_surface():
    points, boundary = bump()
    net = np.asarray(based(points, boundary).control_points)
    coons = np.asarray(jf.base_surface(boundary, points, NET).control_points)
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        np.testing.assert_allclose(net[edge], coons[edge], atol=1e-15)


def test_a_finer_last_grid_comes_nearer():
    points, boundary = bump()
    points[:, 2] += 0.05 * np.sin(12 * points[:, 0]) * points[:, 1] * (1 - points[:, 1])
    net = (16, 14)
    coarse = jf.base_surface(boundary, points, net, method=jf.DynamicBaseSurface(start=1, rounds=1))
    fine = jf.base_surface(boundary, points, net, method=jf.DynamicBaseSurface())
    assert mean_error(fine, points) < mean_error(coarse, points)


def test_where_the_coons_surface_is_right_it_stays():
    grid = helpers.wavy_grid(30, 30, 0.0)
    boundary = jf.Boundary.from_grid(grid)
    net = based(grid.reshape(-1, 3), boundary).control_points
    np.testing.assert_allclose(net, jf.base_surface(boundary, net=NET).control_points, atol=1e-12)


def test_a_pull_is_the_weighted_mean_along_the_normal():
    rng = np.random.default_rng(0)
    points, grid = rng.normal(size=(50, 3)), rng.normal(size=(4, 3))
    normals = rng.normal(size=(4, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moves, sure = directed_projection(grid, normals, np.full(4, 0.7), points)
    for p, n, move, presence in zip(grid, normals, moves, sure, strict=True):
        step = points - p
        along, square = step @ n, np.sum(step**2, axis=1)
        near = np.exp(-(square - along**2) / (2 * 0.49))
        weight = near / (1 + square / 0.49) ** 2
        assert move == pytest.approx(weight @ along / weight.sum(), rel=1e-10)
        assert presence == pytest.approx(near.sum() / (near.sum() + 0.25), rel=1e-10)


def test_host_splines_are_those_of_the_package():
    surface = helpers.random_surface(order=(4, 3), repeats=0)
    knots = np.asarray(surface.knots_u)
    np.testing.assert_allclose(greville(knots, 4), jf.greville_abscissae(knots, 4), atol=1e-14)
    curve = surface.iso_v(0.0)
    at = np.linspace(0, 1, 33)
    values = basis_matrix(knots, 4, at) @ np.asarray(curve.control_points)
    np.testing.assert_allclose(values, curve(at), atol=1e-12)


def test_order_of_points_and_place_do_not_matter():
    points, boundary = bump(200)
    points = np.concatenate([points, points[:50]])
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    net = np.asarray(based(points, boundary).control_points)
    again = based(rng.permutation(points), boundary).control_points
    np.testing.assert_allclose(again, net, atol=1e-10)
    moved = jax.tree.map(lambda x: 300 * x @ turn.T + 1e3, boundary)
    there = (np.asarray(based(300 * points @ turn.T + 1e3, moved).control_points) - 1e3) @ turn / 300
    np.testing.assert_allclose(there, net, atol=1e-9)
    far = jax.tree.map(lambda x: x + 5e6, boundary)
    there = np.asarray(based(points + 5e6, far).control_points) - 5e6
    np.testing.assert_allclose(there, net, atol=1e-5)


def test_gross_outliers_hardly_pull():
    points, boundary = bump(2000)
    spoilt = points.copy()
    spoilt[:20] += np.random.default_rng(2).normal(size=(20, 3))
    assert mean_error(based(spoilt, boundary), points[20:]) < 6e-3


@pytest.mark.parametrize("kind", ["hole", "outside", "on a line", "20", "1", "copies", "far away"])
def test_poor_clouds_give_finite_surfaces_within_reach(kind):
    points, boundary = bump(600)
    x, y, _ = points.T
    poor = {
        "hole": points[np.hypot(x - 0.5, y - 0.5) > 0.3],
        "outside": points * [2.0, 1.0, 1.0],
        "on a line": np.linspace([0.1, 0.2, 0.0], [0.9, 0.7, 0.1], 40),
        "20": points[:20],
        "1": points[:1],
        "copies": np.repeat(points[:2], 40, axis=0),
        "far away": points + np.array([0.0, 0.0, 1.5]),
    }[kind]
    net = np.asarray(based(poor, boundary).control_points)
    assert np.isfinite(net).all()
    assert np.abs(net).max() < 4


def test_a_scanned_head_that_overhangs():
    arrays = helpers.data("mannequin_head")
    boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
    method = jf.DynamicBaseSurface(most_points=1000)
    surface = jf.base_surface(boundary, arrays["points"], (16, 16), method=method)
    assert mean_error(surface, arrays["points"]) < 1.5e-2


def test_what_cannot_be_is_refused():
    points, boundary = bump(50)
    with pytest.raises(ValueError, match=r"points must be given for DynamicBaseSurface\(\)"):
        jf.base_surface(boundary, method=jf.DynamicBaseSurface())
    flat = jf.Boundary.from_grid(helpers.wavy_grid(5, 5)[..., :2])
    with pytest.raises(ValueError, match="boundary must have 3 coordinates"):
        jf.base_surface(flat, points[:, :2], method=jf.DynamicBaseSurface())
    with pytest.raises(ValueError, match=r"growth must be a number of at least 1\.1"):
        jf.DynamicBaseSurface(growth=1.0)
