"""Knot vectors follow their formulas and merge without losing a knot."""

from collections import Counter

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from jaxfit._splines import (
    BSplineCurve,
    averaging_knots,
    clamped_uniform_knots,
    find_span,
    greville_abscissae,
    merge_knots,
)


@pytest.mark.float32_too
def test_uniform_knots():
    knots = clamped_uniform_knots(7, 4, (1.0, 3.0))
    assert knots.dtype == jnp.result_type(float)
    np.testing.assert_allclose(knots, [1, 1, 1, 1, 1.5, 2, 2.5, 3, 3, 3, 3], atol=4 * helpers.eps())
    np.testing.assert_array_equal(clamped_uniform_knots(2, 2), [0, 0, 1, 1])


def test_averaging_knots_equal_the_formula_of_the_paper():
    t = np.array([0.0, 0.1, 0.15, 0.4, 0.7, 0.9, 1.0])
    order, n = 4, len(t) - 1
    inner = [t[k : k + order - 1].sum() / (order - 1) for k in range(1, n - order + 2)]
    expected = [0.0] * order + inner + [1.0] * order
    np.testing.assert_allclose(averaging_knots(t, order), expected, atol=1e-15)
    np.testing.assert_allclose(jax.jit(averaging_knots, static_argnums=1)(t, 4), expected)


@given(st.integers(0, 1000), st.sampled_from([2, 4]))
def test_averaging_knots_make_the_collocation_matrix_regular(seed, order):
    t = np.sort(np.random.default_rng(seed).random(9))
    knots = np.asarray(averaging_knots(t, order))
    matrix = BSpline.design_matrix(t, knots, order - 1).toarray()
    assert np.linalg.matrix_rank(matrix, tol=1e-9) == 9


@pytest.mark.float32_too
@pytest.mark.parametrize("order", [2, 4, 7])
def test_greville_abscissae_reproduce_the_parameter(order):
    rng = np.random.default_rng(order)
    knots = helpers.random_clamped_knots(rng, order + 4, order, 2) * 0.7 + 0.1
    abscissae = greville_abscissae(knots, order)
    u = np.linspace(0.1, 0.8, 11)
    line = BSplineCurve(np.asarray(abscissae)[:, None], knots)
    np.testing.assert_allclose(line(u)[:, 0], u, atol=8 * helpers.eps())
    # Exactly, not to rounding: the ends are used as parameters.
    assert abscissae[0] == line.knots[0]
    assert abscissae[-1] == line.knots[-1]
    np.testing.assert_array_equal(line.greville(), abscissae)


def test_merged_knots_hold_every_knot_as_often_as_either_vector():
    ends = [0.0] * 3, [1.0] * 3
    a = np.array([*ends[0], 0.2, 0.5, 0.5, *ends[1]])
    b = np.array([*ends[0], 0.2, 0.2, 0.3, 0.5, *ends[1]])
    merged = merge_knots(a, b, 3)
    np.testing.assert_array_equal(merged, [*ends[0], 0.2, 0.2, 0.3, 0.5, 0.5, *ends[1]])
    np.testing.assert_array_equal(merge_knots(a, a, 3), a)
    assert merged.dtype == a.dtype


def test_merging_snaps_what_differs_by_rounding():
    a = np.array([0.0, 0.0, 0.3, 1.0, 1.0])
    b = np.array([0.0, 0.0, 0.3 + 1e-14, 0.6, 1.0, 1.0])
    assert merge_knots(a, b, 2).size == 7
    merged = merge_knots(a, b, 2, tolerance=1e-12)
    np.testing.assert_array_equal(merged, [0.0, 0.0, 0.3, 0.6, 1.0, 1.0])
    # Two knots of b may fall on one of a: their multiplicity is kept.
    b = np.array([0.0, 0.0, 0.3 - 1e-14, 0.3 + 1e-14, 1.0, 1.0])
    np.testing.assert_array_equal(merge_knots(a, b, 2, 1e-12), [0, 0, 0.3, 0.3, 1, 1])


@given(st.integers(0, 1000))
def test_curves_agree_on_their_merged_knots(seed):
    rng = np.random.default_rng(seed)
    a, b = (helpers.random_clamped_knots(rng, 9, 4, 2) for _ in range(2))
    b[5] = a[6]
    b.sort()
    merged = merge_knots(a, b, 4)
    curve = BSplineCurve(rng.normal(size=(9, 2)), a)
    missing = Counter(merged.tolist()) - Counter(a.tolist())
    finer = curve.insert_knots(np.sort(list(missing.elements())))
    np.testing.assert_array_equal(finer.knots, merged)


def test_spans_are_never_empty():
    knots = jnp.asarray([0.0, 0, 0, 0.5, 0.5, 1, 1, 1, 1, 1])
    u = jnp.asarray([-1.0, 0.0, 0.2, 0.5, 0.7, 1.0, 2.0])
    np.testing.assert_array_equal(find_span(knots, 3, u), [2, 2, 2, 4, 4, 4, 4])


def test_bad_knot_requests_say_what_to_do():
    with pytest.raises(ValueError, match="count must be at least the order 4"):
        clamped_uniform_knots(3, 4)
    with pytest.raises(ValueError, match="domain must increase"):
        clamped_uniform_knots(5, 4, (1.0, 1.0))
    with pytest.raises(ValueError, match=r"parameters must not decrease, but parameters\[2\]"):
        averaging_knots(np.array([0.0, 0.5, 0.4, 1.0]), 3)
    with pytest.raises(ValueError, match="parameters must be at least the order 4"):
        averaging_knots(np.array([0.0, 0.5, 1.0]), 4)
    with pytest.raises(ValueError, match="order must be at least 2"):
        averaging_knots(np.array([0.0, 0.5, 1.0]), 1)
    with pytest.raises(ValueError, match="order must lie between 2 and"):
        greville_abscissae(np.array([0.0, 1.0]), 1)
    with pytest.raises(ValueError, match="a and b must share one domain"):
        merge_knots(np.array([0.0, 0, 1, 1]), np.array([0.0, 0, 2, 2]), 2)
    with pytest.raises(ValueError, match="b must not decrease"):
        merge_knots(np.array([0.0, 0, 1, 1]), np.array([0.0, 1, 0, 1]), 2)
    with pytest.raises(TypeError, match="merge_knots needs concrete knots"):
        jax.jit(lambda a: merge_knots(a, a, 2))(np.array([0.0, 0, 1, 1]))
