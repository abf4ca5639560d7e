"""Fits that are differentiated as they were run: both modes agree with central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfit as jf

STEP = 1e-6
UNROLLED = jf.UnrolledAdjoint()
POINTS_AT = np.random.default_rng(3).random((2, 120))


def height(u, v):
    return 0.3 * np.sin(2 * u) * v + 0.4 * u * (1 - u) * v * (1 - v) * np.sin(5 * u + v)


def cloud():
    noise = 0.01 * np.random.default_rng(4).normal(size=POINTS_AT.shape[1])
    return np.stack([*POINTS_AT, height(*POINTS_AT) + noise], axis=1)


def border():
    x, y = np.meshgrid(np.linspace(0, 1, 12), np.linspace(0, 1, 9), indexing="ij")
    return jf.Boundary.from_grid(np.stack([x, y, height(x, y)], axis=2))


def base(order=(4, 4)):
    return jf.base_surface(border(), net=(6, 7), order=order)


def few_steps(points, surface, method, steps=4, **options):
    """A number that depends on the control points that are in use and on the errors."""
    options = {"tol_average": None, "tol_maximum": 1e-9, "adjoint": UNROLLED} | options
    fit = jf.approximate(points, surface, method, max_steps=steps, **options)
    return jnp.sum(jnp.sin(20 * fit.surface(0.3, 0.6)) + fit.surface(0.8, 0.2) ** 2) + jnp.sum(fit.errors)


def directions(x):
    rng = np.random.default_rng(5)
    return jax.tree.map(lambda y: jnp.asarray(rng.normal(size=np.shape(y))), x)


def slope(function, x, d, step=STEP):
    ends = (jax.tree.map(lambda a, b, s=s: a + s * step * b, x, d) for s in (1, -1))
    above, below = (float(function(end)) for end in ends)
    return (above - below) / (2 * step)


def inner(x, y):
    pairs = zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True)
    return float(sum(jnp.vdot(a, b) for a, b in pairs))


METHODS = {
    "geometric": jf.GeometricApproximation(loss=jf.Huber(0.02)),
    "standard": jf.StandardApproximation(1e-5),
    "orthogonal": jf.OrthogonalDistance(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_reverse_and_forward_mode_agree_with_central_differences(name):
    def of(inputs):
        return few_steps(inputs["points"], base(), METHODS[name], weights=inputs["weights"])

    inputs = {"points": jnp.asarray(cloud()), "weights": jnp.linspace(0.5, 1.5, POINTS_AT.shape[1])}
    d = directions(inputs)
    forward = float(jax.jvp(of, (inputs,), (d,))[1])
    assert inner(jax.grad(of)(inputs), d) == pytest.approx(forward, rel=1e-9)
    assert forward == pytest.approx(slope(of, inputs, d), rel=1e-5)


FORWARD = {
    "paper": lambda p: few_steps(
        p,
        base(),
        jf.GeometricApproximation.paper(insertion=jf.KnotInsertion(every=3), fairing=jf.Fairing(every=2)),
    ),
    "orders 3 and 4, inserted knots": lambda p: few_steps(
        p, base((3, 4)), jf.OrthogonalDistance(smoothing=1e-6, insertion=jf.KnotInsertion(every=2))
    ),
    "free border": lambda p: few_steps(p, base(), jf.StandardApproximation(1e-5, border=jf.FreeBorder())),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FORWARD)
def test_derivatives_follow_new_knots_fairing_and_a_free_border(name):
    points = jnp.asarray(cloud())
    d = directions(points)
    assert float(jax.jvp(FORWARD[name], (points,), (d,))[1]) == pytest.approx(
        slope(FORWARD[name], points, d), rel=1e-5
    )


@pytest.mark.slow
def test_numbers_base_and_start_have_derivatives():
    surface = base()

    def of(x):
        moved = jf.BSplineSurface(x["base"], surface.knots_u, surface.knots_v)
        method = jf.StandardApproximation(x["smoothing"], parameter_correction=False)
        return few_steps(cloud(), moved, method, steps=1, start=(x["u"], x["v"]))

    u, v = jnp.asarray(0.1 + 0.8 * POINTS_AT)
    x = {"base": surface.control_points, "smoothing": jnp.asarray(1e-3), "u": u, "v": v}
    d = directions(x) | {"smoothing": jnp.asarray(1e-3)}
    gradient = jax.grad(of)(x)
    assert all(float(jnp.max(jnp.abs(y))) > 0 for y in gradient.values())
    assert inner(gradient, d) == pytest.approx(slope(of, x, d), rel=1e-6)


@pytest.mark.slow
def test_a_weight_of_zero_has_the_derivative_to_the_right():
    def of(weight):
        weights = jnp.ones(POINTS_AT.shape[1]).at[7].set(weight)
        return few_steps(cloud(), base(), METHODS["standard"], weights=weights)

    right = (float(of(jnp.asarray(STEP))) - float(of(jnp.asarray(0.0)))) / STEP
    assert float(jax.grad(of)(jnp.asarray(0.0))) == pytest.approx(right, rel=1e-4)


@pytest.mark.slow
def test_a_fit_that_converges_before_its_last_step_is_followed_as_far_as_it_went():
    surface, method = base(), jf.GeometricApproximation()
    goals = {"tol_average": 6e-3, "tol_maximum": None}

    def of(points):
        return few_steps(points, surface, method, steps=50, **goals)

    points = jnp.asarray(cloud())
    fit = jf.approximate(points, surface, method, max_steps=50, adjoint=UNROLLED, **goals)
    assert fit.converged
    assert 0 < int(fit.stats["num_steps"]) < 50
    d = directions(points)
    assert inner(jax.jit(jax.grad(of))(points), d) == pytest.approx(slope(of, points, d), rel=1e-5)


@pytest.mark.slow
def test_a_batch_has_the_derivatives_of_its_clouds():
    both = jnp.stack([jnp.asarray(cloud()), 1.1 * jnp.asarray(cloud())])
    gradient = jax.grad(lambda p: few_steps(p, base(), jf.GeometricApproximation()))
    together = jax.vmap(gradient)(both)
    for points, found in zip(both, together, strict=True):
        np.testing.assert_allclose(found, gradient(points), rtol=1e-8, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_the_fit_differs_little_from_one_without_a_derivative(name):
    options = {"tol_average": None, "tol_maximum": 1e-9, "max_steps": 4}
    plain, followed = (
        jf.approximate(cloud(), base(), METHODS[name], adjoint=adjoint, **options)
        for adjoint in (None, UNROLLED)
    )
    assert float(followed.average_error) == pytest.approx(float(plain.average_error), rel=1e-3)
    assert followed.message == plain.message


def test_a_negative_number_of_moves_gets_a_sentence():
    with pytest.raises(ValueError, match="moves_followed must be a whole number of at least 0"):
        jf.UnrolledAdjoint(moves_followed=-3)
