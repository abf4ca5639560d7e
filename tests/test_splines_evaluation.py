"""Values and derivatives equal SciPy's, whatever the orders, knots, dimensions and shapes."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline, NdBSpline

from jaxfit._splines import BSplineCurve, BSplineSurface
from jaxfit._splines._basis import spans_and_weights
from jaxfit._splines._evaluate import BLOCK, LARGEST_UNBLOCKED

# Every order from 2 to 8, always mixed.
ORDERS = [(2, 6), (4, 3), (5, 4), (8, 7)]
UP_TO_SECOND = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]


def scipy_partial(surface, u, v, du=0, dv=0, extrapolate=False):
    knots = np.asarray(surface.knots_u, float), np.asarray(surface.knots_v, float)
    degrees = tuple(k - 1 for k in surface.order)
    net = np.asarray(surface.control_points, float)
    spline = NdBSpline(knots, net, degrees, extrapolate=extrapolate)
    return spline(np.stack([u, v], axis=-1), nu=(du, dv))


def assert_close(actual, expected, units):
    """Equal to `units` rounding units of the largest number: 4000 of them are 1e-12."""
    expected = np.asarray(expected)
    scale = np.abs(expected).max()
    assert np.abs(np.asarray(actual) - expected).max() <= units * helpers.eps() * scale


@pytest.mark.float32_too
@pytest.mark.parametrize("order", ORDERS)
def test_partial_derivatives_equal_scipy(order):
    surface = helpers.random_surface(order, repeats=3)
    u, v = helpers.parameters_on_knots(surface)
    partials = surface.derivatives(u, v, 2)
    for du, dv in UP_TO_SECOND:
        if du >= order[0] or dv >= order[1]:
            assert not partials[du, dv].any()
            continue
        # A derivative jumps at a repeated knot; SciPy takes it from the right as well.
        assert_close(partials[du, dv], scipy_partial(surface, u, v, du, dv), 4000)


def test_each_way_of_asking_gives_the_same_numbers():
    surface = helpers.random_surface()
    u, v = helpers.parameters_on_knots(surface)
    partials = surface.derivatives(u, v, 2)
    assert_close(surface(u, v), partials[0, 0], 8)
    assert_close(surface.derivative(u, v, 1, 1), partials[1, 1], 8)
    assert_close(np.einsum("iid->id", surface.grid(u, v, 1, 0)), partials[1, 0], 8)
    assert_close(surface.transpose()(v, u), partials[0, 0], 8)
    along_v, along_u = surface.iso_u(u[3]), surface.iso_v(v[3])
    assert_close(along_v(v), surface(u[3], v), 8)
    assert_close(along_u(u), surface(u, v[3]), 8)


def test_third_derivatives_and_those_beyond_the_degree():
    surface = helpers.random_surface()
    u, v = helpers.parameters_on_knots(surface)
    assert_close(surface.derivative(u, v, 3, 2), scipy_partial(surface, u, v, 3, 2), 4000)
    assert not surface.derivative(u, v, 4, 0).any()


@pytest.mark.parametrize("d", [1, 2, 5])
def test_any_dimension(d):
    surface = helpers.random_surface((3, 2), d)
    u, v = helpers.parameters_on_knots(surface)
    assert surface(u, v).shape == (*u.shape, d)
    assert_close(surface(u, v), scipy_partial(surface, u, v), 100)


@pytest.mark.parametrize("order", [2, 8])
def test_curves_equal_scipy(order):
    rng = np.random.default_rng(order)
    knots = helpers.random_clamped_knots(rng, order + 5, order, repeats=3)
    curve = BSplineCurve(rng.normal(size=(order + 5, 2)), knots)
    spline = BSpline(knots, np.asarray(curve.control_points), order - 1)
    u = np.resize(np.concatenate([np.unique(knots), rng.random(40)]), (2, 20))
    outside = np.resize([-0.3, 1.2], (2, 20))
    for du in range(2):
        assert_close(curve.derivative(u, du), spline(u, nu=du), 4000)
        assert_close(curve.derivative(outside, du), spline(np.clip(outside, 0, 1), nu=du), 4000)
    assert_close(curve(outside, extrapolate=True), spline(outside), 4000)


def test_parameters_outside_are_moved_to_the_border_or_continue_the_pieces():
    surface = helpers.random_surface()
    u, v = 2 * helpers.parameters_on_knots(surface) - 0.5
    moved = np.clip(u, 0, 1), np.clip(v, 0, 1)
    assert_close(surface(u, v), scipy_partial(surface, *moved), 4000)
    assert_close(surface.derivative(u, v, 1, 1), scipy_partial(surface, *moved, 1, 1), 4000)
    continued = surface.derivative(u, v, 1, 1, extrapolate=True)
    assert_close(continued, scipy_partial(surface, u, v, 1, 1, extrapolate=True), 4000)
    assert_close(surface.grid(u, v, 1, 0), surface.grid(*moved, 1, 0), 1)


@pytest.mark.float32_too
def test_corners_of_a_clamped_net_are_met_exactly():
    surface = helpers.random_surface()
    ends = np.resize([0.0, 1.0], 40)
    corners = surface.grid(ends, ends)[:2, :2]
    np.testing.assert_array_equal(corners, surface.control_points[::8, ::7])


@pytest.mark.float32_too
def test_derivatives_lose_no_digits_far_from_the_origin():
    # Like map coordinates, millions of metres from it. Multiples of 1/256 are exact in the sum.
    near = helpers.random_surface()
    net = np.round(np.asarray(near.control_points) * 256) / 256
    here, there = (BSplineSurface(x, near.knots_u, near.knots_v) for x in (net, net + 2.0**10))
    u, v = helpers.parameters_on_knots(near)
    moved, unmoved = (s.derivatives(u, v, 2) for s in (there, here))
    for key in UP_TO_SECOND[1:]:
        np.testing.assert_array_equal(moved[key], unmoved[key])
    for method in ("derivative", "grid"):
        near_by, far_off = (getattr(s, method)(u, v, 1, 1) for s in (here, there))
        np.testing.assert_array_equal(far_off, near_by)


def test_surplus_end_knots_and_their_control_points_have_no_influence():
    surface = helpers.random_surface()
    net = np.concatenate([surface.control_points, np.full((4, 8, 3), 7.0)])
    padded = BSplineSurface(net, np.append(surface.knots_u, np.ones(4)), surface.knots_v)
    u, v = helpers.parameters_on_knots(surface)
    assert padded.order == surface.order
    np.testing.assert_array_equal(padded(u, v), surface(u, v))
    np.testing.assert_array_equal(padded.split().control_points, surface.split().control_points)
    # A knot goes in, a surplus end knot comes off: still the same surface in the same shapes.
    finer = padded.insert_knots(u=np.array([0.3]))
    same = BSplineSurface(finer.control_points[:-1], finer.knots_u[:-1], finer.knots_v)
    assert_close(same(u, v), surface(u, v), 8)
    repeated = surface.insert_knots(u=np.ones(4))
    np.testing.assert_array_equal(repeated.knots_u, padded.knots_u)
    assert_close(repeated(u, v), surface(u, v), 8)


def test_unclamped_knots_equal_scipy():
    rng = np.random.default_rng(3)
    knots = np.cumsum(rng.uniform(0.1, 1.0, 12))
    curve = BSplineCurve(rng.normal(size=(8, 2)), knots)
    spline = BSpline(knots, np.asarray(curve.control_points), 3)
    u = np.linspace(*curve.domain, 6)
    assert_close(curve(u), spline(u), 100)
    assert_close(curve.insert_knots(u[2:5])(u), spline(u), 100)
    pieces, breakpoints = curve.split()
    assert_close(spline(breakpoints[1:]), pieces[:, -1], 100)


def test_shapes_of_parameters_broadcast():
    surface = helpers.wavy_surface()

    def shape(*parameters):
        return jax.eval_shape(surface, *parameters).shape

    assert shape(0.5, 0.5) == (3,)
    assert shape(np.zeros((2, 3)), 0.5) == (2, 3, 3)
    assert shape(np.zeros((2, 1)), np.zeros((1, 3))) == (2, 3, 3)
    assert shape(np.zeros(0), np.zeros(0)) == (0, 3)
    with pytest.raises(ValueError, match=r"u and v must have equal .* grid\(us, vs\)"):
        surface(np.zeros(2), np.zeros(3))
    with pytest.raises(ValueError, match="us must have one dimension"):
        surface.grid(np.zeros((2, 2)), np.zeros(3))
    with pytest.raises(ValueError, match="du must not be negative"):
        surface.derivative(0.5, 0.5, -1, 0)
    with pytest.raises(TypeError, match="parameters must be real"):
        surface(1j, 0.5)


def test_integer_parameters_are_numbers_too():
    surface = helpers.random_surface()
    np.testing.assert_array_equal(surface(0, 1), surface.control_points[0, -1])
    assert surface(0, 1).dtype == surface.control_points.dtype


def test_large_inputs_in_blocks_equal_small_ones():
    surface = helpers.random_surface()
    u, v = np.random.default_rng(0).random((2, LARGEST_UNBLOCKED + BLOCK // 2))
    whole = surface(u.reshape(2, -1), v.reshape(2, -1)).reshape(-1, 3)
    for part in (slice(0, 40), slice(-40, None)):
        assert_close(whole[part], surface(u[part], v[part]), 4)


def test_the_reference_surface_is_reproduced():
    data = helpers.data("bspline_reference")
    net = data["control_points"].reshape(6, 6, 3)
    surface = BSplineSurface(net, data["knots_u"], data["knots_v"])
    allowed = 1e-12 * helpers.diagonal(data["points"])
    points = surface(*data["params"].T)
    assert np.abs(points - data["points"]).max() < allowed
    (a, b), (c, d) = surface.domain
    grid = surface.grid(np.linspace(a, b, 40), np.linspace(c, d, 40))
    assert np.abs(grid - data["grid40"]).max() < allowed


@pytest.mark.float32_too
@given(st.integers(0, 1000))
def test_basis_functions_are_a_partition_of_unity(seed):
    rng = np.random.default_rng(seed)
    order = 5
    dtype = jnp.result_type(float)
    knots = jnp.asarray(helpers.random_clamped_knots(rng, 10, order, seed % 5), dtype)
    u = jnp.asarray(np.concatenate([rng.random(18), [0.0, 1.0]]), dtype)
    weights = jax.jit(spans_and_weights, static_argnums=(1, 3, 4))(knots, order, u, (0, 1, 2), False)[1]
    values, *slopes = np.asarray(weights)
    assert values.shape == (order, 20)
    assert values.min() >= 0
    np.testing.assert_allclose(values.sum(axis=0), 1.0, atol=8 * helpers.eps())
    for table in slopes:
        np.testing.assert_allclose(table.sum(axis=0), 0.0, atol=100 * helpers.eps() * np.abs(table).max())


@pytest.mark.float32_too
def test_affine_maps_commute_with_evaluation():
    rng = np.random.default_rng(0)
    surface = helpers.random_surface()
    matrix, offset = rng.normal(size=(3, 3)), rng.normal(size=3)
    u, v = helpers.parameters_on_knots(surface)
    expected = np.asarray(surface(u, v)) @ matrix.T + offset
    assert_close(surface.affine(matrix, offset)(u, v), expected, 20)
    curve = surface.iso_u(u[3])
    assert_close(curve.affine(matrix)(v), np.asarray(curve(v)) @ matrix.T, 20)
    assert surface.affine(matrix[:2]).dimension == 2
    with pytest.raises(ValueError, match="matrix must have shape"):
        surface.affine(np.eye(2))
    with pytest.raises(ValueError, match="offset must have shape"):
        surface.affine(np.eye(3), np.zeros(2))


def test_nan_parameters_give_nan_points_only_there():
    surface = helpers.random_surface()
    u, v = helpers.parameters_on_knots(surface)
    u[3] = np.nan
    finite = np.isfinite(surface(u, v)).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(~finite), [3])


def test_equal_shapes_compile_once():
    surface = helpers.random_surface()
    u, v = helpers.parameters_on_knots(surface)
    surface(u, v), surface.derivatives(u, v)
    other = jax.tree.map(lambda x: 2 * x, surface)
    with helpers.count_compilations() as compiled:
        other(u, v), other.derivatives(u, v)
    assert compiled.count == 0
