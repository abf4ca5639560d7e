"""Derivatives of fits of clouds, beside central differences of the public call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import wavy_cloud

import jaxfit as jf

RNG = np.random.default_rng(1)
POINTS = wavy_cloud(200)[0] + 0.01 * RNG.normal(size=(200, 3))
WEIGHTS = RNG.uniform(0.5, 2.0, 200)
EDGES = wavy_cloud(200)[1]
PLACES = jnp.array([0.3, 0.7, 0.2]), jnp.array([0.4, 0.1, 0.8])
FACTORS = jnp.array([[1.0, -2.0, 3.0]])
NEAR = wavy_cloud(200)[0]

# Each with the base surface's net and order, and the points.
CASES = {
    "plate": (lambda x: jf.OrthogonalDistance(smoothing=x), 1e-5, (6, 7), (4, 4)),
    "default": (lambda x: jf.OrthogonalDistance(jf.RegularSmoothing(least=x)), 5.0, (6, 7), (4, 4)),
    "robust, free": (
        lambda x: jf.OrthogonalDistance(smoothing=x, loss=jf.Huber(), border=jf.FreeBorder()),
        1e-5,
        (6, 7),
        (3, 4),
    ),
    "new knots": (
        lambda x: jf.OrthogonalDistance(smoothing=x, insertion=jf.KnotInsertion(every=3, most=2)),
        1e-5,
        (6, 7),
        (4, 4),
    ),
    "standard": (lambda x: jf.StandardApproximation(smoothing=x), 1e-3, (9, 8), (3, 4)),
    "at given parameters": (
        lambda x: jf.StandardApproximation(smoothing=x, parameter_correction=False),
        1e-4,
        (6, 7),
        (4, 4),
    ),
    "geometric": (lambda x: jf.GeometricApproximation(loss=jf.Huber(scale=x)), 0.05, (6, 7), (4, 4)),
}


def base_of(net, order):
    """Off the height field, but with its border."""
    base = jf.base_surface(jf.Boundary(**EDGES), net=net, order=order)
    inside = np.zeros((*net, 3))
    inside[1:-1, 1:-1] = 0.003 * np.random.default_rng(2).normal(size=(net[0] - 2, net[1] - 2, 3))
    return jf.BSplineSurface(base.control_points + inside, base.knots_u, base.knots_v)


def height(method, base, points, weights, number, net, adjoint=None):
    """A number that a fit comes to, and how stationary the fit is."""
    base = jf.BSplineSurface(net, base.knots_u, base.knots_v)
    options = dict(tol_average=1e-12, max_steps=40, weights=weights, adjoint=adjoint)
    fit = jf.approximate(points, base, method(number), **options)
    value = jnp.sum(fit.surface(*PLACES) * FACTORS) + 20 * jnp.mean(fit.errors**2)
    return value, fit.stats["stationarity"]


def central_difference(function, arguments, place, direction, step):
    ends = []
    for sign in (1, -1):
        moved = list(arguments)
        moved[place] = arguments[place] + sign * step * direction
        ends.append(float(function(*moved)))
    return (ends[0] - ends[1]) / (2 * step)


@pytest.mark.parametrize("name", CASES)
def test_the_derivative_is_that_of_the_polished_fit(name):
    method, number, net, order = CASES[name]
    points = NEAR if name == "geometric" else POINTS
    base = base_of(net, order)
    arguments = (points, WEIGHTS, number, np.asarray(base.control_points))
    both = jax.value_and_grad(lambda *x: height(method, base, *x), argnums=(0, 1, 2, 3), has_aux=True)
    (value, stationarity), gradient = both(*arguments)
    assert stationarity <= 1e-12

    def polished(*x):
        return height(method, base, *x, adjoint=jf.ImplicitAdjoint())[0]

    np.testing.assert_allclose(polished(*arguments), value, rtol=1e-12)
    rng = np.random.default_rng(3)
    directions = [rng.normal(size=np.shape(x)) for x in arguments[:2]] + [number]
    directions.append(rng.normal(size=arguments[3].shape))
    for place, direction in enumerate(directions):
        # So short that hardly a foot reaches a border of the domain, where the derivative jumps.
        step = (1e-7, 1e-6, 1e-5, 1e-7)[place]
        difference = central_difference(polished, arguments, place, direction, step)
        slope = float(jnp.sum(gradient[place] * direction))
        assert abs(slope - difference) <= 1e-6 * abs(difference) + 1e-8, (place, slope, difference)
    tangents = [jnp.asarray(x, float) for x in directions]
    forward = jax.jvp(
        lambda *x: height(method, base, *x)[0], [jnp.asarray(x, float) for x in arguments], tangents
    )
    backward = sum(float(jnp.sum(g * x)) for g, x in zip(gradient, tangents, strict=True))
    np.testing.assert_allclose(float(forward[1]), backward, rtol=1e-8)
    if name in ("plate", "default"):
        inside = np.asarray(gradient[3])[1:-1, 1:-1]
        assert not inside.any()  # where the fit starts from does not matter
