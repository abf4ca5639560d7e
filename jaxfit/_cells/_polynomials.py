"""Evaluating polynomial pieces with their derivatives, by Horner's rule."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

Coefficient = Callable[[int, int], Array]  # of s^a t^b, of all coordinates


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
    return _jet(lambda a, b: coefficients[:, a, b], coefficients.shape[:3], s, t)


def evaluate_values(
    coefficients: Float[Array, "d K L ..."], s: Float[Array, "..."], t: Float[Array, "..."]
) -> Float[Array, "d ..."]:
    """The value alone."""
    return _partial(lambda a, b: coefficients[:, a, b], coefficients.shape[:3], s, t, 0, 0)


def jet_along_rows(
    coefficients: Float[Array, "rows d K L"], s: Float[Array, "rows width"], t: Float[Array, "rows width"]
) -> Jet:
    """`evaluate_jet` for rows whose coefficients lie side by side, as they are fetched: to lay them out
    otherwise would be a copy.
    """
    return _jet(*_of_rows(coefficients), s, t)


def values_along_rows(
    coefficients: Float[Array, "rows d K L"], s: Float[Array, "rows width"], t: Float[Array, "rows width"]
) -> Float[Array, "d rows width"]:
    """The value alone."""
    return _partial(*_of_rows(coefficients), s, t, 0, 0)


def _of_rows(coefficients: Array) -> tuple[Coefficient, tuple[int, ...]]:
    return lambda a, b: coefficients[:, :, a, b].T[..., None], coefficients.shape[1:]


def _jet(c: Coefficient, shape: tuple[int, ...], s: Array, t: Array) -> Jet:
    orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    return Jet(*(_partial(c, shape, s, t, i, j) for i, j in orders))


def _partial(c: Coefficient, shape: tuple[int, ...], s: Array, t: Array, i: int, j: int) -> Array:
    """The derivative of order (i, j) of the polynomial with coefficients c(a, b), `shape` being (d, K, L)."""
    d, order_u, order_v = shape
    rows = [horner([c(a, b) for b in range(order_v)], t[None], j) for a in range(order_u)]
    everywhere = (d, *jnp.broadcast_shapes(c(0, 0).shape[1:], s.shape))
    return jnp.broadcast_to(horner(rows, s[None], i), everywhere)


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
