"""Derivatives of fits of clouds, beside central differences of the public call."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_except, wavy_cloud

import jaxfit as jf

RNG = np.random.default_rng(1)
POINTS = wavy_cloud(200)[0] + 0.01 * RNG.normal(size=(200, 3))
WEIGHTS = RNG.uniform(0.5, 2.0, 200)
EDGES = wavy_cloud(200)[1]
PLACES = jnp.array([0.3, 0.7, 0.2]), jnp.array([0.4, 0.1, 0.8])
FACTORS = jnp.array([[1.0, -2.0, 3.0]])
AT_ROUNDING = jf.ImplicitAdjoint(residual=0.0)

# Each with a number, and the net and the order of the base surface. Other tests fit 200 points with weights
# and a net of (6, 7) too: so they share programs.
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
    "geometric": (lambda x: jf.GeometricApproximation(loss=jf.Huber(scale=x)), 5e-3, (6, 7), (4, 4)),
}


def base_of(net, order):
    """Off the height field, but with its border."""
    base = jf.base_surface(jf.Boundary(**EDGES), net=net, order=order)
    inside = np.zeros((*net, 3))
    inside[1:-1, 1:-1] = 0.003 * np.random.default_rng(2).normal(size=(net[0] - 2, net[1] - 2, 3))
    return jf.BSplineSurface(base.control_points + inside, base.knots_u, base.knots_v)


def near(base):
    """Points near a surface with the net of `base`: without smoothing others do not determine a net."""
    rng = np.random.default_rng(5)
    bump = np.zeros(base.control_points.shape)
    bump[1:-1, 1:-1, 2] = 0.1 * rng.normal(size=(base.shape[0] - 2, base.shape[1] - 2))
    surface = jf.BSplineSurface(base.control_points + bump, base.knots_u, base.knots_v)
    return np.asarray(surface(*rng.uniform(size=(2, 400)))) + 1e-3 * rng.normal(size=(400, 3))


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


@pytest.mark.parametrize("name", slow_except(CASES, "at given parameters"))
def test_the_derivative_is_that_of_the_polished_fit(name):
    method, number, net, order = CASES[name]
    base = base_of(net, order)
    points = near(base) if name == "geometric" else POINTS
    weights = np.resize(WEIGHTS, len(points))
    arguments = (points, weights, number, np.asarray(base.control_points))
    both = jax.value_and_grad(lambda *x: height(method, base, *x), argnums=(0, 1, 2, 3), has_aux=True)
    (value, stationarity), gradient = both(*arguments)
    assert stationarity <= 1e-12

    def polished(*x):
        return height(method, base, *x, adjoint=AT_ROUNDING)[0]

    np.testing.assert_allclose(polished(*arguments), value, rtol=1e-9)
    rng = np.random.default_rng(3)
    directions = [rng.normal(size=np.shape(x)) for x in arguments[:2]] + [number]
    directions.append(rng.normal(size=arguments[3].shape))
    for place, direction in enumerate(directions):
        # So short that hardly a foot reaches a border of the domain, where the derivative jumps; and then
        # rounding is a millionth of a single difference.
        steps, least = ((1e-7, 2e-7, 4e-7), (1e-4,), (1e-4,), (1e-6,))[place], (1e-7, 1e-7, 1e-7, 1e-6)[place]
        difference = np.median([central_difference(polished, arguments, place, direction, x) for x in steps])
        slope = float(jnp.sum(gradient[place] * direction))
        assert abs(slope - difference) <= 1e-6 * abs(difference) + least, (place, slope, difference)
    if name in ("default", "standard"):  # forward mode is the same rule for all
        tangents = [jnp.asarray(x, float) for x in directions]
        primals = [jnp.asarray(x, float) for x in arguments]
        forward = jax.jvp(lambda *x: height(method, base, *x)[0], primals, tangents)[1]
        backward = sum(float(jnp.sum(g * x)) for g, x in zip(gradient, tangents, strict=True))
        np.testing.assert_allclose(float(forward), backward, rtol=1e-7)
    if name == "default":
        inside = np.asarray(gradient[3])[1:-1, 1:-1]
        assert not inside.any()  # where the fit starts from does not matter


BASE = base_of((6, 7), (4, 4))
# Three of the cases, whose programs are there.
REGULAR, PLATE, GROWING = (CASES[name][0](CASES[name][1]) for name in ("default", "plate", "new knots"))


def height_of(points, weights, adjoint=None, max_steps=40, method=PLATE):
    options = dict(tol_average=1e-12, max_steps=max_steps, weights=weights, adjoint=adjoint)
    fit = jf.approximate(points, BASE, method, **options)
    return jnp.sum(fit.surface(*PLACES) * FACTORS)


@pytest.mark.slow
def test_gradients_run_in_jit_and_vmap():
    slope = jax.grad(partial(height_of, method=REGULAR), argnums=(0, 1))
    single = slope(POINTS, WEIGHTS)
    clouds = jnp.stack([POINTS, POINTS * 1.01])
    batch = jax.jit(jax.vmap(slope, (0, None)))(clouds, WEIGHTS)
    for one, many in zip(single, batch, strict=True):
        np.testing.assert_allclose(many[0], one, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", [PLATE, GROWING], ids=["plate", "new knots"])
def test_points_on_the_border_coincident_ones_and_weights_of_zero_have_the_right_derivative(method):
    special = np.asarray(BASE(jnp.array([0.0, 1.0, 0.0, 0.4]), jnp.array([0.3, 1.0, 0.0, 0.0])))
    outside = np.array([[-0.1, -0.1, 0.0], [0.5, -0.05, 0.02]])
    points = np.concatenate([POINTS[:192], special, outside, POINTS[:1], POINTS[:1]])
    weights = np.concatenate([WEIGHTS[:192], np.ones(7), [0.0]])
    gradient = jax.grad(partial(height_of, method=method), argnums=(0, 1))(points, weights)
    assert all(np.isfinite(x).all() for x in gradient)
    direction = np.zeros(points.shape)
    direction[192:] = np.random.default_rng(0).normal(size=(8, 3))
    direction[[0, 198]] = 1.0
    direction[192:196] = 0.0  # on the border, where the derivative is one-sided

    def polished(*x):
        return height_of(*x, adjoint=AT_ROUNDING, method=method)

    difference = central_difference(polished, (points, weights), 0, direction, 1e-7)
    np.testing.assert_allclose(jnp.sum(gradient[0] * direction), difference, rtol=1e-6, atol=1e-7)
    more = weights.copy()
    more[-1] = 1e-6
    one_sided = float(polished(points, more) - polished(points, weights)) / 1e-6
    np.testing.assert_allclose(gradient[1][-1], one_sided, rtol=1e-4)
    assert not np.asarray(gradient[0][-1]).any()  # the point of weight 0


@pytest.mark.slow
def test_a_surface_that_is_not_at_rest_says_so():
    early = dict(max_steps=2, tol_average=1e-12, weights=WEIGHTS)
    fit = jf.approximate(POINTS, BASE, PLATE, **early, adjoint=jf.ImplicitAdjoint(polish_steps=0))
    assert float(fit.stats["stationarity"]) > 1e-4
    assert "stationarity" not in jf.approximate(POINTS, BASE, PLATE, **early).stats


@pytest.mark.slow
@pytest.mark.parametrize("method", [PLATE, REGULAR], ids=["plate", "default"])
def test_a_derivative_far_from_rest_is_refused(method):
    def slope(adjoint):
        options = dict(max_steps=1, method=method)
        return jax.grad(height_of, argnums=(0, 1))(POINTS, WEIGHTS, adjoint, **options)[0]

    with pytest.raises(
        ArithmeticError, match=r"not at rest .* OrthogonalDistance with a number as smoothing"
    ):
        slope(jf.ImplicitAdjoint(polish_steps=0))
    np.testing.assert_allclose(slope(jf.ImplicitAdjoint()), slope(None), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_within_jit_a_derivative_far_from_rest_is_no_number():
    adjoint = jf.ImplicitAdjoint(polish_steps=0)
    slope = jax.jit(lambda x: jax.grad(height_of)(x, WEIGHTS, adjoint, max_steps=1))
    assert np.isnan(slope(jnp.asarray(POINTS))).all()


@pytest.mark.slow
def test_a_derivative_not_quite_at_rest_comes_with_a_warning():
    slope = partial(jax.grad(height_of), POINTS, WEIGHTS, max_steps=5)
    with pytest.warns(UserWarning, match=r"may be far off: .* \(stationarity 1.8e-04, more than 1e-06\)"):
        slope(adjoint=jf.ImplicitAdjoint(polish_steps=0))


def test_methods_that_do_not_come_to_rest_refuse_before_they_fit():
    steps = []
    for method in (jf.GeometricApproximation.paper(), jf.GeometricApproximation(local=True)):
        for derivative, adjoint in ((jax.grad, None), (lambda f: f, jf.ImplicitAdjoint())):

            def error(points, method=method, adjoint=adjoint):
                options = dict(max_steps=1, adjoint=adjoint, progress=lambda *step: steps.append(step))
                return jf.approximate(points, BASE, method, **options).average_error

            with pytest.raises(TypeError, match="has no derivative"):
                derivative(error)(jnp.asarray(POINTS))
    assert not steps


@pytest.mark.slow
def test_numbers_of_a_method_may_be_traced():
    @jax.jit
    def errors(relaxation, scale, reach, least):
        geometric = jf.GeometricApproximation(relaxation=relaxation, loss=jf.Huber(scale=scale))
        smooth = jf.OrthogonalDistance(jf.RegularSmoothing(least=least), reach=reach)
        fits = [jf.approximate(POINTS, BASE, m, max_steps=2) for m in (geometric, smooth)]
        return jnp.stack([fit.average_error for fit in fits])

    assert np.isfinite(errors(1.1, 0.05, 0.5, 4.0)).all()


@pytest.mark.slow
def test_a_cloud_with_its_boundary_is_differentiable_in_its_points_and_weights():
    boundary = jf.Boundary(**EDGES)

    def height(points, weights, adjoint=None):
        options = dict(net=(6, 7), method=REGULAR, tol_average=1e-12, max_steps=40, base=jf.Coons())
        fit = jf.fit_points(points, boundary, **options, weights=weights, adjoint=adjoint)
        return jnp.sum(fit.surface(*PLACES) * FACTORS)

    arguments, rng = (POINTS, WEIGHTS), np.random.default_rng(0)
    gradient = jax.grad(height, argnums=(0, 1))(*arguments)
    for place, x in enumerate(arguments):
        direction = rng.normal(size=x.shape)
        step = (1e-7, 1e-5)[place]
        difference = central_difference(lambda *x: height(*x, AT_ROUNDING), arguments, place, direction, step)
        np.testing.assert_allclose(jnp.sum(gradient[place] * direction), difference, rtol=1e-6, atol=1e-9)
    with pytest.raises(TypeError, match="net must be given"):
        jax.grad(lambda x: jf.fit_points(x, boundary).average_error)(np.tile(POINTS, (3, 1)))


@pytest.mark.parametrize("transformation", [jax.grad, jax.jit])
def test_a_boundary_that_is_traced_is_refused_in_a_sentence(transformation):
    def error(sides):
        return jf.fit_points(POINTS, jf.Boundary(**sides), net=(6, 7)).average_error

    with pytest.raises(TypeError, match=r"boundary must be concrete, but is traced; .* coons_surface"):
        transformation(error)({side: jnp.asarray(x) for side, x in EDGES.items()})


@pytest.mark.slow
@pytest.mark.float32_too
def test_in_single_precision_the_fit_is_polished_to_rounding():
    points, weights = (jnp.asarray(x, float) for x in (POINTS, WEIGHTS))
    base, method = base_of((6, 7), (4, 4)), jf.StandardApproximation(smoothing=1e-4)

    def height(points, adjoint):
        fit = jf.approximate(points, base, method, tol_average=1e-3, weights=weights, adjoint=adjoint)
        return jnp.sum(fit.surface(*PLACES) * FACTORS)

    found = jax.grad(height)(points, jf.ImplicitAdjoint())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # there is no rounding that is small enough for this one
        exact = jax.grad(height)(points, AT_ROUNDING)
    assert jnp.linalg.norm(found - exact) < 2e-3 * jnp.linalg.norm(exact)


def test_raw_scans_refuse_to_be_differentiated_before_they_are_meshed(monkeypatch):
    monkeypatch.setattr("jaxfit._approximation._fit_without_boundary.sheet_of", None)
    with pytest.raises(TypeError, match="boundary must be given where"):
        jax.grad(lambda weights: jf.fit_points(POINTS, weights=weights).average_error)(WEIGHTS)
    with pytest.raises(TypeError, match="boundary must be given where"):
        jax.grad(lambda x: jf.fit_points(POINTS, method=jf.OrthogonalDistance(x)).average_error)(1e-3)
    with pytest.raises(TypeError, match="boundary must be given where"):
        jf.fit_points(POINTS, adjoint=jf.ImplicitAdjoint())


@pytest.mark.parametrize("name", slow_except(["plate", "unrolled", "grid"], "unrolled"))
def test_a_fit_whose_feet_move_is_not_differentiated_twice(name):
    """It would be a wrong number."""
    grid = (
        np.asarray(EDGES["u0"])[:, None] * [[[1.0], [0.9], [0.7], [0.5]]]
        + np.eye(3)[1] * np.arange(4)[:, None]
    )
    functions = {
        "plate": lambda t: height_of(POINTS + t, WEIGHTS)[0],
        "unrolled": lambda t: height_of(POINTS + t, WEIGHTS, adjoint=jf.UnrolledAdjoint(), max_steps=2)[0],
        "grid": lambda t: jf.interpolate(grid + t * grid**2).surface(0.3, 0.6)[2],
    }
    with pytest.raises(TypeError, match="differentiable once only"):
        jax.grad(jax.grad(functions[name]))(0.0)


@pytest.mark.slow
def test_standard_interpolation_has_a_second_derivative():
    x, y = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 5), indexing="ij")
    grid = np.stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y)], axis=-1)
    move = np.random.default_rng(3).normal(size=grid.shape)

    def height(t):
        return jnp.sum(jf.interpolate(grid + t * move, jf.StandardInterpolation()).surface(0.37, 0.41) ** 3)

    slope = jax.grad(height)
    difference = (slope(1e-5) - slope(-1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(slope)(0.0), difference, rtol=1e-6)
