"""Derivatives and batches outside `jit` are those inside, and a second call of them compiles nothing."""

from functools import partial

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfit as jf

SURFACE = helpers.wavy_surface(7, 6)
NET = SURFACE.control_points
RNG = np.random.default_rng(0)
POINTS = np.asarray(SURFACE(*RNG.uniform(size=(2, 200)))) + 0.01 * RNG.normal(size=(200, 3))


def distance(net):
    surface = jf.BSplineSurface(net, SURFACE.knots_u, SURFACE.knots_v)
    return jnp.sum(jf.closest_point(surface, POINTS).distance)


def of_a_curve(net):
    return jnp.sum(jf.closest_point(jf.BSplineCurve(net[:, 0], SURFACE.knots_u), POINTS).distance)


def interpolated(grid):
    return jnp.sum(jf.interpolate(grid).surface.control_points ** 2)


def fitted(points, correction=True):
    method = jf.StandardApproximation(1e-3, parameter_correction=correction)
    fit = jf.approximate(points, SURFACE, method, tol_average=1e-9)
    return jnp.sum(fit.surface.control_points)


CASES = {
    "closest point": (distance, NET),
    "closest point of a curve": (of_a_curve, NET),
    "interpolate": (interpolated, NET),
    "approximate": (fitted, POINTS),
    "at given parameters": (partial(fitted, correction=False), POINTS),
}
HOW = {"grad": jax.grad, "vmap": lambda function: lambda x: jax.vmap(function)(jnp.stack([x, x]))}


@pytest.mark.parametrize("how", helpers.slow_except(HOW, "grad"))
@pytest.mark.parametrize("name", helpers.slow_except(CASES, "closest point", "closest point of a curve"))
def test_a_second_one_compiles_nothing(name, how):
    function, argument = CASES[name]
    first = HOW[how](function)(jnp.asarray(argument))
    with helpers.count_compilations() as compiled:
        second = HOW[how](function)(jnp.asarray(argument))
    assert compiled.count == 0
    np.testing.assert_array_equal(first, second)
    inside = jax.jit(HOW[how](function))(jnp.asarray(argument))
    np.testing.assert_allclose(first, inside, rtol=1e-7, atol=1e-7 * float(np.abs(inside).max()))


def test_grad_alone_searches_as_a_plain_call_does():
    # A tube: the queries near its axis have feet all around, more than two of which compete.
    angle, along = np.linspace(0, 1.9 * np.pi, 14), np.linspace(0, 1, 5)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * (1 + 0.05 * np.cos(5 * angle))[:, None]
    grid = np.concatenate(
        [np.repeat(circle[:, None], 5, 1), np.tile(along[None, :, None], (14, 1, 1))], axis=2
    )
    tube = jf.interpolate(grid).surface
    rng = np.random.default_rng(0)
    points = np.concatenate([0.01 * rng.normal(size=(300, 2)), rng.uniform(size=(300, 1))], axis=1)

    def distances(points):
        return jf.closest_point(tube, points).distance

    values, _ = jax.vjp(distances, points)
    np.testing.assert_allclose(values, distances(points), rtol=0, atol=1e-13)
