"""Evaluating polynomial pieces with their derivatives, by Horner's rule."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float


class Jet(NamedTuple):
    """Value and derivatives up to second order, in local coordinates, the space coordinate first."""

    value: Float[Array, "d ..."]
    s: Float[Array, "d ..."]
    t: Float[Array, "d ..."]
    ss: Float[Array, "d ..."]
    st: Float[Array, "d ..."]
    tt: Float[Array, "d ..."]


def evaluate_jet(
    coefficients: Float[Array, "d K L ..."], s: Float[Array, "..."], t: Float[Array, "..."]
) -> Jet:
    """Value and all derivatives up to order two.

    `coefficients` broadcasts against `s` and `t`: one value per row for points in rows, one per point
    elsewhere. Each derivative is a rule of its own: as vector loops over points, six short ones compile and
    run faster than one that shares everything.
    """
    orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    return Jet(*(_partial(coefficients, s, t, i, j) for i, j in orders))


def evaluate_values(
    coefficients: Float[Array, "d K L ..."], s: Float[Array, "..."], t: Float[Array, "..."]
) -> Float[Array, "d ..."]:
    """The value alone."""
    return _partial(coefficients, s, t, 0, 0)


def _partial(c: Array, s: Array, t: Array, i: int, j: int) -> Array:
    """The derivative of order (i, j)."""
    order_u, order_v = c.shape[1:3]
    rows = [horner([c[:, a, b] for b in range(order_v)], t[None], j) for a in range(order_u)]
    shape = (c.shape[0], *jnp.broadcast_shapes(c.shape[3:], s.shape))
    return jnp.broadcast_to(horner(rows, s[None], i), shape)


def horner(c: Sequence[Array], x: Array, derivative: int) -> Array:
    """p(x), p'(x) or p''(x) for p with coefficients c[0] + c[1] x + ..., by nested multiplication."""
    terms = []
    for power in range(derivative, len(c)):
        factor = math.perm(power, derivative)
        terms.append(c[power] if factor == 1 else float(factor) * c[power])
    if not terms:
        return jnp.zeros_like(c[0])
    result = terms[-1]
    for term in reversed(terms[:-1]):
        result = result * x + term
    return result
