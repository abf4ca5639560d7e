"""B-spline basis functions by the Cox-de Boor recursion, one step for all of them at once."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxfit._splines._lookup import last_not_above, windows


def find_span(knots: Float[Array, " knots"], order: int, u: Float[Array, "*shape"]) -> Int[Array, "*shape"]:
    r"""Index $l$ of the non-empty knot span $t_l \le u < t_{l+1}$ that holds each parameter.

    The right end of the domain belongs to the last non-empty span, and parameters outside the
    domain get the nearest end span. End knots may be repeated more often than `order` times:
    empty spans are never returned, so every denominator of the recursion is positive.
    """
    start, stop = knots[order - 1], knots[knots.shape[0] - order]
    first = lax.reduce((knots <= start).astype(np.int32), np.int32(0), lax.add, (0,)) - 1
    last = lax.reduce((knots < stop).astype(np.int32), np.int32(0), lax.add, (0,)) - 1
    return lax.clamp(first, last_not_above(knots, u), last)


def clamp(knots: Float[Array, " knots"], order: int, u: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Parameters moved to the nearest point of the domain."""
    start, stop = (jnp.broadcast_to(x, u.shape).astype(u.dtype) for x in (knots[order - 1], knots[-order]))
    # Not jnp.clip, which halves the gradient of a parameter that lies exactly on an end.
    return lax.select(u < start, start, lax.select(u > stop, stop, u))


def local_knots(
    knots: Float[Array, " knots"], order: int, span: Int[Array, "*shape"]
) -> Float[Array, "local *shape"]:
    """The 2 (order - 1) knots around each span that the recursion touches, left to right."""
    return windows(knots, span + (2 - order), 2 * order - 2)


def _raised(weights: Float[Array, "p *shape"], away: Float[Array, "local *shape"]) -> Float[Array, "..."]:
    """One step of the recursion: from the weights of order p to those of order p + 1.

    `away` are the local knots less the parameter.
    """
    p, middle = weights.shape[0], away.shape[0] // 2
    left, right = away[middle - p : middle], away[middle : middle + p]
    width = right - left
    # Two quotients, not one and its complement: small weights keep their relative accuracy,
    # and the end weights of a clamped knot vector are exactly zero and one.
    return _between_zeros(weights * (right / width), 0, 1) - _between_zeros(weights * (left / width), 1, 0)


def _differentiated(
    weights: Float[Array, "p *shape"], local: Float[Array, "local *shape"]
) -> Float[Array, "..."]:
    """The same step for the derivative: N'_{i,p+1} = p (N_{i,p}/(..) - N_{i+1,p}/(..))."""
    p, middle = weights.shape[0], local.shape[0] // 2
    slope = p * weights / (local[middle : middle + p] - local[middle - p : middle])
    return _between_zeros(slope, 1, 0) - _between_zeros(slope, 0, 1)


def _between_zeros(x: Array, before: int, after: int) -> Array:
    """`x` between so many zeros along the first axis."""
    return lax.pad(x, np.zeros((), x.dtype), [(before, after, 0), *[(0, 0, 0)] * (x.ndim - 1)])


def blossom_weights(
    local: Float[Array, "local *shape"], arguments: Float[Array, "arguments *shape"]
) -> Float[Array, "order *shape"]:
    r"""Weights of the control points in the blossom of one polynomial piece.

    The piece on the span $l$ has the symmetric multi-affine form
    $f(x_1, \dots, x_{K-1}) = \sum_r w_r P_{l-K+1+r}$. Equal arguments give the basis functions
    (NURBS Book, algorithm A2.2), consecutive knots of a refined knot vector give knot insertion,
    and mixtures of the two ends of the span give the Bezier points.
    """
    weights = jnp.ones((1, *local.shape[1:]), local.dtype)
    for x in arguments:
        weights = _raised(weights, local - x[None])
    return weights


def nonzero_basis(
    local: Float[Array, "local *shape"], u: Float[Array, "*shape"], derivatives: tuple[int, ...]
) -> Float[Array, "derivatives order *shape"]:
    """For each wanted derivative the weights of the `order` control points of the span."""
    order = local.shape[0] // 2 + 1
    tables, away = [jnp.ones((1, *u.shape), u.dtype)], local - u[None]
    for _ in range(order - 1):
        tables.append(_raised(tables[-1], away))
    wanted = []
    for derivative in derivatives:
        weights = tables[order - 1 - derivative] if derivative < order else jnp.zeros_like(tables[-1])
        while weights.shape[0] < order:
            weights = _differentiated(weights, local)
        wanted.append(weights)
    return jnp.stack(wanted)


def spans_and_weights(
    knots: Float[Array, " knots"],
    order: int,
    u: Float[Array, "*shape"],
    derivatives: tuple[int, ...],
    extrapolate: bool,
) -> tuple[Int[Array, "*shape"], Float[Array, "derivatives order *shape"]]:
    """First control point of each parameter, and its weights for each wanted derivative."""
    if not extrapolate:
        u = clamp(knots, order, u)
    span = find_span(knots, order, u)
    return span - (order - 1), nonzero_basis(local_knots(knots, order, span), u, derivatives)


def as_parameters(u: ArrayLike, like: Array) -> Array:
    """`u` as a floating array of at least the precision of `like`."""
    u = jnp.asarray(u)
    if jnp.issubdtype(u.dtype, jnp.complexfloating):
        raise TypeError(f"parameters must be real, but have dtype {u.dtype}; pass real numbers.")
    return u.astype(jnp.result_type(u, like))
