"""Evaluating polynomial pieces with their derivatives, by Horner's rule."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

PARTIALS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # orders of the derivatives in a jet


class Jet(NamedTuple):
    """Value and derivatives up to second order, in local coordinates, the space coordinate first."""

    value: Float[Array, "d ..."]
    s: Float[Array, "d ..."]
    t: Float[Array, "d ..."]
    ss: Float[Array, "d ..."]
    st: Float[Array, "d ..."]
    tt: Float[Array, "d ..."]


def evaluate_jet(
    coefficients: Float[Array, "rows d K L"], s: Float[Array, "rows width"], t: Float[Array, "rows width"]
) -> Jet:
    """Value and all derivatives up to order two, of one polynomial a row."""
    return Jet(*_along_rows(coefficients, s, t, PARTIALS))


def evaluate_first_order(
    coefficients: Float[Array, "rows d K L"], s: Float[Array, "rows width"], t: Float[Array, "rows width"]
) -> list[Float[Array, "d rows width"]]:
    """Value, and its derivatives along s and t."""
    return _along_rows(coefficients, s, t, PARTIALS[:3])


def evaluate_values(
    coefficients: Float[Array, "rows d K L"], s: Float[Array, "rows width"], t: Float[Array, "rows width"]
) -> Float[Array, "d rows width"]:
    """The value alone."""
    return _along_rows(coefficients, s, t, PARTIALS[:1])[0]


def _along_rows(coefficients: Array, s: Array, t: Array, partials: Sequence[tuple[int, int]]) -> list[Array]:
    # Each derivative is a rule of its own, from the coefficients: that takes less time than
    # rules that share intermediate results, which would have to be stored.
    rows, d, order_u, order_v = coefficients.shape
    flat = coefficients.reshape(rows, d, order_u * order_v).transpose(1, 0, 2)
    return polynomial_partials(
        lax.split(flat, (1,) * (order_u * order_v), 2), order_v, s[None], t[None], partials
    )


def polynomial_partials(
    coefficients: Sequence[Array],
    order_v: int,
    s: Float[Array, "..."],
    t: Float[Array, "..."],
    partials: Sequence[tuple[int, int]],
) -> list[Array]:
    """Derivatives of sum_ab c_ab s^a t^b; the coefficients are in row-major order and broadcast against s."""
    rows = [coefficients[k : k + order_v] for k in range(0, len(coefficients), order_v)]
    everywhere = jnp.broadcast_shapes(coefficients[0].shape, s.shape)
    found = (horner([horner(row, t, j) for row in rows[i:]], s, i, i) for i, j in partials)
    return [x if x.shape == everywhere else jnp.broadcast_to(x, everywhere) for x in found]


def horner(c: Sequence[Array], x: Array, derivative: int, begin: int = 0) -> Any:
    """p(x) or a derivative, for p with the coefficients c of x^begin, x^(begin + 1), ..., by nested
    multiplication; `begin` is at most `derivative`.
    """
    result: Any = None
    for power in reversed(range(derivative, begin + len(c))):
        factor, term = math.perm(power, derivative), c[power - begin]
        term = term if factor == 1 else float(factor) * term
        result = term if result is None else result * x + term
    return jnp.zeros_like(x) if result is None else result


def powers(x: Float[Array, "..."], count: int) -> Float[Array, "count ..."]:
    """1, x, x^2, ..."""
    found, power = jnp.ones_like(x)[None], x[None]
    while found.shape[0] < count:
        found = jnp.concatenate([found, found[: count - found.shape[0]] * power])
        power = power * power
    return found
