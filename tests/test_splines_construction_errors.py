"""What is no spline is refused in one sentence, and pytree operations are left in peace."""

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit._splines import BSplineCurve, BSplineSurface

NET = helpers.wavy_net(6, 5)
KU, KV = helpers.clamped_uniform(6, 4), helpers.clamped_uniform(5, 3)


def changed(array, index, value):
    array = np.array(array, float)
    array[index] = value
    return array


BAD = {
    "control_points must have 3 dimensions": (NET[0], KU, KV),
    "control_points must have at least one coordinate": (NET[..., :0], KU, KV),
    "control_points must be finite": (changed(NET, (0, 0, 0), np.nan), KU, KV),
    "control_points must hold real numbers": (NET.astype(complex), KU, KV),
    "control_points must number at least the order 4": (
        NET[:3],
        np.r_[np.zeros(3), 1, 1, 1, 1],
        KV,
    ),
    r"knots_u must hold 6 \+ order knots": (NET, KU[:7], KV),
    r"knots_v must hold 5 \+ order knots": (NET, KU, np.linspace(0, 1, 14)),
    "knots_v must have 1 dimension": (NET, KU, KV[None]),
    r"knots_u must not decrease, but knots_u\[5\]": (NET, changed(KU, 4, 0.9), KV),
    "knots_v must be finite": (NET, KU, changed(KV, 3, np.inf)),
    "knots_v must span a domain": (NET, KU, np.ones(8)),
    "knots_u must repeat no interior knot": (
        np.concatenate([NET, NET]),
        np.r_[np.zeros(4), np.full(5, 0.5), 0.6, 0.7, 0.8, np.ones(4)],
        KV,
    ),
}


@pytest.mark.parametrize("sentence", BAD)
def test_bad_surfaces_are_refused(sentence):
    with pytest.raises((ValueError, TypeError), match=sentence) as caught:
        BSplineSurface(*BAD[sentence])
    text = str(caught.value)
    assert text.endswith(".")
    assert ";" in text, "the sentence says what to do"


def test_bad_curves_are_refused():
    with pytest.raises(ValueError, match="knots must not decrease"):
        BSplineCurve(NET[:, 0], KU[::-1])
    with pytest.raises(ValueError, match=r"knots must hold 6 \+ order knots"):
        BSplineCurve(NET[:, 0], KU[:6])


@pytest.mark.parametrize("order", range(2, 9))
def test_every_order_from_two_to_eight_is_accepted(order):
    knots = helpers.clamped_uniform(9, order)
    assert BSplineCurve(np.zeros((9, 1)), knots).order == order


@pytest.mark.float32_too
def test_inputs_become_jax_arrays_of_one_dtype():
    surface = BSplineSurface(NET.astype(np.float32), KU, KV.astype(np.float32))
    assert {x.dtype for x in jax.tree.leaves(surface)} == {jnp.result_type(float)}
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(surface))
    integers = BSplineCurve(np.arange(4).reshape(2, 2), np.array([0, 0, 1, 1]))
    assert integers.knots.dtype == jnp.result_type(float)


def test_single_precision_stays_single():
    surface = helpers.wavy_surface(dtype=jnp.float32)
    u = jnp.asarray([0.2, 0.4], jnp.float32)

    def everything():
        return (
            *(surface(u, 0.5), surface.normal(u, u), surface.curvature(u, u), surface.split()),
            *(surface.insert_knots(np.array([0.3])), surface.greville(), surface.iso_u(0.2)),
        )

    for leaf in jax.tree.leaves(jax.eval_shape(everything)):
        assert leaf.dtype == jnp.float32


def test_values_are_not_looked_at_inside_jit():
    # Knots that decrease would be refused outside; inside only shapes are known.
    built = jax.jit(BSplineSurface)(NET, KU[::-1], KV)
    assert built.order == (4, 3)
    with pytest.raises(ValueError, match="knots_u must hold"):
        jax.jit(BSplineSurface)(NET, KU[:5], KV)


def test_pytree_operations_need_no_valid_surface():
    surface = BSplineSurface(NET, KU, KV)
    assert jax.tree.leaves(jax.tree.map(lambda _: object(), surface)) != []
    assert jax.tree.leaves(eqx.filter(surface, lambda _: False)) == []
    arrays, rest = eqx.partition(surface, eqx.is_array)
    same = eqx.combine(arrays, rest)
    np.testing.assert_array_equal(same(0.3, 0.4), surface(0.3, 0.4))
    moved = eqx.tree_at(lambda s: s.control_points, surface, surface.control_points + 1)
    np.testing.assert_allclose(moved(0.3, 0.4), surface(0.3, 0.4) + 1)
    shapes = eqx.filter_eval_shape(lambda: BSplineSurface(NET, KU, KV))
    assert shapes.control_points.shape == NET.shape


def test_masked_control_points_are_refused():
    net = np.ma.masked_greater(np.random.default_rng(0).random((4, 4, 3)), 0.9)
    with pytest.raises(ValueError, match="control_points must not be masked"):
        BSplineSurface(net, *[np.repeat([0.0, 1.0], 4)] * 2)
