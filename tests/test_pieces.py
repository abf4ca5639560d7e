"""Polynomial pieces are the surface, derivative by derivative."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit._cells import evaluate_jet, evaluate_values
from jaxfit._splines import BSplineCurve, BSplineSurface
from jaxfit._splines._pieces import as_surface_arrays, make_axis, make_pieces

PARTIALS = {"value": (0, 0), "s": (1, 0), "t": (0, 1), "ss": (2, 0), "st": (1, 1), "tt": (0, 2)}


def jet_at(pieces, u, v):
    """The jet at (u, v), its derivatives turned into those by u and v."""
    jet, value = _jet_at(pieces, jnp.asarray(u), jnp.asarray(v))
    np.testing.assert_allclose(value, jet["value"], rtol=1e-5, atol=100 * helpers.eps())
    return jet


@jax.jit
def _jet_at(pieces, u, v):
    axes = (pieces.axis_u, pieces.axis_v)
    i, j = (axis.locate(x) for axis, x in zip(axes, (u, v), strict=True))
    s = (u - axes[0].centre[i]) / axes[0].half[i]
    t = (v - axes[1].centre[j]) / axes[1].half[j]
    cell = jnp.asarray(pieces.coefficients)[i * axes[1].cells + j]
    jet = {name: x[..., 0] for name, x in evaluate_jet(cell, s[:, None], t[:, None])._asdict().items()}
    scale = {"s": axes[0].half[i], "t": axes[1].half[j]}
    result = {}
    for name, parts in jet.items():
        result[name] = jnp.stack(parts, axis=-1)
        for x in name if name != "value" else ():
            result[name] /= scale[x][:, None]
    return result, evaluate_values(cell, s[:, None], t[:, None])[..., 0].T


@pytest.mark.float32_too
@pytest.mark.parametrize("repeats", [0, 3])
@pytest.mark.parametrize("order", [(2, 3), (4, 4), (6, 5), (8, 7)])
def test_pieces_equal_the_surface_and_its_derivatives(order, repeats):
    surface = helpers.random_surface(order, repeats=repeats)
    pieces = make_pieces(*as_surface_arrays(surface))
    u, v = helpers.parameters_on_knots(surface)
    actual = jet_at(pieces, u, v)
    tolerance = 4.0 ** max(order) * helpers.eps()
    partials = surface.derivatives(u, v, 2)
    for name, partial in PARTIALS.items():
        expected = np.asarray(partials[partial])
        # Narrow spans have large derivatives: judge by the largest.
        np.testing.assert_allclose(
            actual[name], expected, rtol=0, atol=tolerance * max(1.0, np.abs(expected).max())
        )


def test_knots_of_full_multiplicity_give_both_sides_their_own_polynomial():
    knots = np.array([0, 0, 0, 0.4, 0.4, 0.4, 1, 1, 1.0])
    surface = BSplineSurface(np.random.default_rng(0).normal(size=(6, 6, 2)), knots, knots)
    pieces = make_pieces(*as_surface_arrays(surface))
    u, v = np.array([0.4, 0.4 - 1e-12, 1.0]), np.array([0.4, 0.2, 0.4])
    assert np.isfinite(pieces.coefficients).all()
    np.testing.assert_allclose(jet_at(pieces, u, v)["value"], surface(u, v), atol=1e-10)


def test_unused_control_points_of_a_fixed_capacity_net_change_nothing():
    surface = helpers.wavy_surface()
    net = np.concatenate([surface.control_points, np.full((3, 6, 3), 9.0)])
    knots = np.concatenate([surface.knots_u, np.ones(3)])
    pieces = make_pieces(jnp.asarray(net), jnp.asarray(knots), surface.knots_v)
    u, v = np.random.default_rng(1).uniform(size=(2, 20))
    u[0] = v[0] = 1.0
    np.testing.assert_allclose(jet_at(pieces, u, v)["value"], surface(u, v), atol=1e-14)
    behind = np.asarray(pieces.coefficients).reshape(pieces.axis_u.cells, pieces.axis_v.cells, 3, 4, -1)[-3:]
    assert (behind[:, :, :, 1:] == 0).all()


def test_a_curve_is_a_surface_of_one_cell_across():
    curve = BSplineCurve(np.random.default_rng(0).normal(size=(7, 2)), helpers.clamped_uniform(7, 4))
    pieces = make_pieces(*as_surface_arrays(curve))
    u = np.linspace(0, 1, 13)
    actual = jet_at(pieces, u, np.zeros(13))
    np.testing.assert_allclose(actual["value"], curve(u), atol=1e-14)
    np.testing.assert_allclose(actual["s"], curve.derivative(u), atol=1e-12)
    assert not actual["t"].any()


def test_stretches_end_at_creases_only():
    knots = jnp.asarray([0, 0, 0, 0.2, 0.5, 0.5, 0.8, 1, 1, 1])  # order 3: a crease at 0.5
    axis = make_axis(knots, 3)
    stretch = np.stack([axis.low, axis.high], axis=1)[axis.locate(jnp.asarray([0.1, 0.3, 0.5, 1]))]
    np.testing.assert_array_equal(stretch, [[0, 0.5], [0, 0.5], [0.5, 1], [0.5, 1]])


@pytest.mark.float32_too
@pytest.mark.parametrize("cells", [1, 2, 29, 30, 61, 200, 1000])
def test_the_cell_of_a_parameter_is_that_of_a_sorted_search(cells):
    rng = np.random.default_rng(cells)
    inner = np.sort(rng.choice(rng.uniform(0, 1, cells), cells - 1))  # some repeat
    knots = np.concatenate([np.zeros(4), inner, np.ones(4)]).astype(jnp.result_type(float))
    axis = make_axis(knots, 4)
    u = np.concatenate([rng.uniform(0, 1, 500), knots, np.nextafter(knots[:-4], 2)]).astype(knots.dtype)
    expected = np.clip(np.searchsorted(axis.breaks, u, side="right") - 1, *axis.ends)
    np.testing.assert_array_equal(jax.jit(lambda u: axis.locate(u))(u), expected)
    np.testing.assert_array_equal(axis.locate(u), expected)


@pytest.mark.float32_too
@pytest.mark.parametrize("order", [(1, 2), (2, 5), (4, 4)])
def test_a_row_of_points_shares_its_polynomial(order):
    rng = np.random.default_rng(8)
    coefficients = jnp.asarray(rng.normal(size=(7, 3, *order)))
    s, t = (jnp.asarray(rng.uniform(-1, 1, (7, 5))) for _ in range(2))
    jet = evaluate_jet(coefficients, s, t)
    each = [evaluate_jet(coefficients, s[:, k : k + 1], t[:, k : k + 1]) for k in range(5)]
    for here, *there in zip(jet, *each, strict=True):
        assert here.shape == (3, 7, 5)
        np.testing.assert_allclose(here, jnp.concatenate(there, axis=2), rtol=0, atol=100 * helpers.eps())
    np.testing.assert_allclose(
        evaluate_values(coefficients, s, t), jet.value, rtol=0, atol=100 * helpers.eps()
    )
