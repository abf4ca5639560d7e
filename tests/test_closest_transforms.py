"""Closest points under jit, vmap and differentiation."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit import BSplineCurve, BSplineSurface, closest_point

COUNT = 8


@pytest.fixture(scope="module")
def problem():
    surface = helpers.wavy_surface(7, 6)
    u, v = np.random.default_rng(0).uniform(0.1, 0.9, (2, COUNT))
    points = surface(u, v) + 0.05 * surface.normal(u, v)
    points = points.at[:3].add(jnp.asarray([[-0.6, 0, 0], [0, 0.9, 0], [2.0, 2.0, 0]]))
    return surface, points, (jnp.asarray(u), jnp.asarray(v))


def feet(net, knots_u, knots_v, points, start):
    return closest_point(BSplineSurface(net, knots_u, knots_v), points, start=start)


jitted = jax.jit(lambda surface, points, start: closest_point(surface, points, start=start))


def test_jit_equals_eager(problem):
    surface, points, start = problem
    for begin in (None, start):
        inside, outside = jitted(surface, points, begin), closest_point(surface, points, begin)
        for name in ("u", "v", "point", "distance"):
            np.testing.assert_allclose(getattr(inside, name), getattr(outside, name), rtol=0, atol=1e-11)
        np.testing.assert_array_equal(inside.status, outside.status)
        assert inside.converged.all()


def test_vmap_over_surfaces_equals_a_loop(problem):
    surface, points, start = problem
    nets = surface.control_points[None] * jnp.asarray([1.0, 0.9, 1.2])[:, None, None, None]
    knots = surface.knots_u, surface.knots_v
    both = jax.jit(jax.vmap(lambda net: feet(net, *knots, points, start)))(nets)
    for k, net in enumerate(nets):
        alone = feet(net, *knots, points, start)
        np.testing.assert_allclose(both.u[k], alone.u, rtol=0, atol=1e-11)
        np.testing.assert_allclose(both.distance[k], alone.distance, rtol=0, atol=1e-12)
    assert both.converged.all()


def test_derivatives_equal_finite_differences(problem):
    surface, points, start = problem
    arrays = (surface.control_points, surface.knots_u, surface.knots_v, points)
    rng = np.random.default_rng(3)
    weights = jnp.asarray(rng.normal(size=(6, COUNT)))

    def number(arrays):
        result = feet(*arrays, start)
        rows = [result.u, result.v, result.distance, *result.point.T]
        return jnp.sum(jnp.stack(rows) * weights)

    both = jax.jit(jax.value_and_grad(number))
    reverse = both(arrays)[1]
    forward = jax.jit(lambda x, dx: jax.jvp(number, (x,), (dx,))[1])
    for which, name in enumerate(("control points", "knots u", "knots v", "points")):
        direction = [np.zeros(x.shape) for x in arrays]
        direction[which] = rng.normal(size=arrays[which].shape)
        if "knots" in name:  # ends stay where they are
            direction[which][:4] = direction[which][-4:] = 0
        ends = [
            both(tuple(x + step * dx for x, dx in zip(arrays, direction, strict=True)))[0]
            for step in (1e-6, -1e-6)
        ]
        expected = float(ends[0] - ends[1]) / 2e-6
        along = float(forward(arrays, tuple(jnp.asarray(x) for x in direction)))
        back = sum(float(jnp.sum(x * dx)) for x, dx in zip(reverse, direction, strict=True))
        assert along == pytest.approx(expected, rel=1e-6, abs=1e-6), name
        assert back == pytest.approx(along, rel=1e-10), name


def test_the_distance_changes_as_the_unit_residual(problem):
    surface, points, start = problem
    slope = jax.jit(jax.grad(lambda x: jnp.sum(jitted(surface, x, start).distance)))(points)
    found = closest_point(surface, points, start)
    expected = np.asarray((points - found.point) / found.distance[:, None])
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-9)


@pytest.mark.float32_too
def test_derivatives_are_finite_on_the_surface_borders_corners_and_poles():
    net = helpers.wavy_net(7, 6)
    net[:, 0] = net[0, 0]  # a pole at v = 0
    wavy = helpers.wavy_surface(7, 6)
    surface = BSplineSurface(jnp.asarray(net), wavy.knots_u, wavy.knots_v)
    u, v = (jnp.asarray(x) for x in ([0.3, 0, 1, 0.5, 0.5, 0, 0.2, 1], [0.4, 0.5, 1, 0, 1, 0, 0, 0]))
    points = surface(u, v)  # distance zero, on borders, in corners, on the pole

    def total(surface, points):
        found = closest_point(surface, points, start=(u, v))
        return jnp.sum(found.distance) + jnp.sum(found.u * found.v) + jnp.sum(found.point)

    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))
    for shift in (0.0, 0.1):
        for leaf in jax.tree.leaves(slopes(surface, points + shift)):
            assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_second_derivatives_equal_differences_of_first_ones(problem):
    surface, points, start = problem

    def total(x):
        found = jitted(surface, x, start)
        return jnp.sum(found.distance**2) + jnp.sum(found.u**2)

    first = jax.jit(jax.grad(total))
    direction = np.random.default_rng(5).normal(size=points.shape)
    second = jax.jit(lambda x, dx: jax.jvp(first, (x,), (dx,))[1])(points, jnp.asarray(direction))
    differences = (first(points + 1e-6 * direction) - first(points - 1e-6 * direction)) / 2e-6
    assert np.isfinite(second).all()
    np.testing.assert_allclose(second, differences, rtol=1e-5, atol=1e-5)


def test_feet_on_curves_differentiate_too():
    curve = BSplineCurve(np.random.default_rng(0).normal(size=(7, 2)), helpers.clamped_uniform(7, 4))
    at = np.linspace(0.1, 0.9, COUNT)
    tangent = np.asarray(curve.derivative(at))
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = curve(at) + 0.02 * normal
    # Moving a point along the tangent moves its foot by dx / (|C'| (1 - curvature * height)).
    slope = jax.jit(jax.jacfwd(lambda x: closest_point(curve, x, start=jnp.asarray(at)).u))(points)
    second = np.asarray(curve.derivative(at, 2))
    expected = tangent / (np.sum(tangent**2, 1) - np.sum(0.02 * normal * second, 1))[:, None]
    np.testing.assert_allclose(slope[np.arange(COUNT), np.arange(COUNT)], expected, rtol=1e-8)


def test_vmap_without_starts_searches_globally():
    surface = helpers.wavy_surface(6, 6)
    points = np.random.default_rng(5).uniform(-0.2, 1.2, (4, 3))
    alone = closest_point(surface, points).distance
    each = jax.vmap(lambda q: closest_point(surface, q[None]).distance[0])(jnp.asarray(points))
    np.testing.assert_allclose(each, alone, atol=1e-12)


@pytest.mark.float32_too
@pytest.mark.parametrize("unit", [1e-25, 1e-8, 1e20])
def test_single_precision_serves_any_unit(unit):
    surface = helpers.wavy_surface(7, 6, dtype=jnp.float32)
    points = np.random.default_rng(0).uniform(-0.2, 1.2, (50, 3)).astype(np.float32)
    knots = surface.knots_u, surface.knots_v

    def found(net, points):
        return closest_point(BSplineSurface(net, *knots), points)

    def slope(found, scale):
        net, points_in_unit = scale * surface.control_points, jnp.asarray(scale * points)
        return jax.grad(lambda net: jnp.sum(found(net, points_in_unit).distance))(net)

    scale = np.float32(unit)
    for way in (found, jax.jit(found)):
        usual, here = way(surface.control_points, points), way(scale * surface.control_points, scale * points)
        assert np.mean(np.asarray(here.converged)) >= np.mean(np.asarray(usual.converged)) - 0.02
        np.testing.assert_allclose(here.distance / scale, usual.distance, rtol=0, atol=1e-5)
        np.testing.assert_allclose(here.point / scale, usual.point, rtol=0, atol=1e-4)
        np.testing.assert_allclose(slope(way, scale), slope(way, np.float32(1.0)), rtol=0, atol=1e-3)


@pytest.mark.float32_too
def test_nothing_is_rounded_far_from_the_origin():
    corner = np.array([1e6, 2e6, 0.0], np.float32)
    x, y = np.meshgrid([0.0, 8.0], [0.0, 8.0], indexing="ij")
    net = np.stack([x, y, 0 * x], axis=2).astype(np.float32) + corner
    knots = np.array([0.0, 0.0, 1.0, 1.0], np.float32)
    points = corner + np.array([[3.0, 4.0, 0.75], [6.0, 1.0, 0.5]], np.float32)

    def distance(points):
        return closest_point(BSplineSurface(net, knots, knots), points).distance

    value, _ = jax.jvp(distance, (jnp.asarray(points),), (jnp.ones_like(points),))
    np.testing.assert_array_equal(value, distance(points))
    np.testing.assert_array_equal(value, [0.75, 0.5])
