"""Evaluating polynomial pieces with their derivatives, by Horner's rule."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

Coordinates = list[Array]  # one array per space coordinate, all of one shape


class Jet(NamedTuple):
    """Value and derivatives up to second order, in local coordinates, a list of coordinates each."""

    value: Coordinates
    s: Coordinates
    t: Coordinates
    ss: Coordinates
    st: Coordinates
    tt: Coordinates


def evaluate_jet(coefficients: Float[Array, "d K L ..."], s: Array, t: Array) -> Jet:
    """Horner's rule for the value and all derivatives up to order two.

    `coefficients` broadcasts against `s` and `t`: one value per row for points in rows, one per point
    elsewhere. Structure of arrays throughout, so that everything fuses into a single vector loop.
    """
    jets = [_jet_of_one(coordinate, s, t) for coordinate in coefficients]
    return Jet(*(list(parts) for parts in zip(*jets, strict=True)))


def _jet_of_one(c: Float[Array, "K L ..."], s: Array, t: Array) -> tuple[Array, ...]:
    in_t = [_horner(list(row), t) for row in c]
    value, first, second = _horner([f for f, _, _ in in_t], s)
    in_t1, mixed, _ = _horner([f for _, f, _ in in_t], s)
    in_t2, _, _ = _horner([f for _, _, f in in_t], s)
    return value, first, in_t1, second, mixed, in_t2


def _horner(c: Sequence[Array], x: Array) -> tuple[Array, Array, Array]:
    """p(x), p'(x), p''(x) for p with coefficients c[0] + c[1] x + ..., by nested multiplication."""
    p = c[-1] + jnp.zeros_like(x)
    first = second = jnp.zeros_like(x)
    for degree, coefficient in enumerate(reversed(c[:-1])):
        if degree > 1:
            second = second * x + 2.0 * first
        elif degree == 1:
            second = 2.0 * first
        first = p if degree == 0 else first * x + p
        p = p * x + coefficient
    return p, first, second


def evaluate_values(coefficients: Float[Array, "d K L ..."], s: Array, t: Array) -> Coordinates:
    """Horner's rule for the value alone."""

    def value(c: Sequence[Array], x: Array) -> Array:
        p = c[-1] + jnp.zeros_like(x)
        for coefficient in reversed(c[:-1]):
            p = p * x + coefficient
        return p

    return [value([value(list(row), t) for row in c], s) for c in coefficients]
