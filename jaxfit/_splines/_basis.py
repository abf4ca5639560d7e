"""B-spline basis functions by the Cox-de Boor recursion, unrolled over the order."""

from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int


def find_span(knots: Float[Array, " knots"], order: int, u: Float[Array, "*shape"]) -> Int[Array, "*shape"]:
    r"""Index $l$ of the non-empty knot span $t_l \le u < t_{l+1}$ that holds each parameter.

    The right end of the domain belongs to the last non-empty span, and parameters outside the
    domain get the nearest end span. End knots may be repeated more often than `order` times:
    empty spans are never returned, so every denominator of the recursion is positive.
    """
    start, stop = knots[order - 1], knots[knots.shape[0] - order]
    first = jnp.searchsorted(knots, start, side="right") - 1
    last = jnp.searchsorted(knots, stop, side="left") - 1
    span = jnp.searchsorted(knots, u, side="right", method="scan_unrolled") - 1
    return jnp.clip(span, first, last)


def clamp(knots: Float[Array, " knots"], order: int, u: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Parameters moved to the nearest point of the domain."""
    start, stop = knots[order - 1], knots[knots.shape[0] - order]
    # Not jnp.clip, which halves the gradient of a parameter that lies exactly on an end.
    return jnp.where(u < start, start, jnp.where(u > stop, stop, u))


def local_knots(
    knots: Float[Array, " knots"], order: int, span: Int[Array, "*shape"]
) -> list[Float[Array, "*shape"]]:
    """The 2 (order - 1) knots around each span that the recursion touches, left to right."""
    take = knots.at
    return [take[span + i].get(mode="promise_in_bounds") for i in range(2 - order, order)]


def _raised(weights: list, local: list, x: Array) -> list:
    """One step of the recursion: from the weights of order p to those of order p + 1 at x."""
    p, middle = len(weights), len(local) // 2
    raised = [0.0] * (p + 1)
    for r, weight in enumerate(weights):
        left, right = local[middle - p + r], local[middle + r]
        # Two quotients, not one and its complement: small weights keep their relative accuracy,
        # and the end weights of a clamped knot vector are exactly zero and one.
        raised[r] = raised[r] + weight * ((right - x) / (right - left))
        raised[r + 1] = weight * ((x - left) / (right - left))
    return raised


def _differentiated(weights: list, local: list) -> list:
    """The same step for the derivative: N'_{i,p+1} = p (N_{i,p}/(..) - N_{i+1,p}/(..))."""
    p, middle = len(weights), len(local) // 2
    raised = [0.0] * (p + 1)
    for r, weight in enumerate(weights):
        slope = p * weight / (local[middle + r] - local[middle - p + r])
        raised[r] = raised[r] - slope
        raised[r + 1] = slope
    return raised


def blossom_weights(local: list, arguments: list, ones: Array) -> list:
    r"""Weights of the control points in the blossom of one polynomial piece.

    The piece on the span $l$ has the symmetric multi-affine form
    $f(x_1, \dots, x_{K-1}) = \sum_r w_r P_{l-K+1+r}$. Equal arguments give the basis functions
    (NURBS Book, algorithm A2.2), consecutive knots of a refined knot vector give knot insertion,
    and mixtures of the two ends of the span give the Bezier points. `ones` (the weight of order
    1) has the shape of the arguments.
    """
    weights = [ones]
    for x in arguments:
        weights = _raised(weights, local, x)
    return weights


def nonzero_basis(local: list, u: Array, derivatives: tuple[int, ...]) -> list[list]:
    """For each wanted derivative the weights of the `order` control points of the span."""
    order = len(local) // 2 + 1
    tables = [[jnp.ones_like(u)]]
    for _ in range(order - 1):
        tables.append(_raised(tables[-1], local, u))
    wanted = []
    for derivative in derivatives:
        if derivative >= order:
            wanted.append([jnp.zeros_like(u)] * order)
            continue
        weights = tables[order - 1 - derivative]
        for _ in range(derivative):
            weights = _differentiated(weights, local)
        wanted.append(weights)
    return wanted


def spans_and_weights(
    knots: Array, order: int, u: Array, derivatives: tuple[int, ...], extrapolate: bool
) -> tuple[Array, list[list]]:
    """First control point of each parameter, and its weights for each wanted derivative."""
    if not extrapolate:
        u = clamp(knots, order, u)
    span = find_span(knots, order, u)
    weights = nonzero_basis(local_knots(knots, order, span), u, derivatives)
    return span - (order - 1), weights


@partial(jax.jit, static_argnames=("order", "derivatives", "extrapolate"))
def _stacked(knots: Array, order: int, u: Array, derivatives: tuple[int, ...], extrapolate: bool) -> Array:
    _, weights = spans_and_weights(knots, order, u, derivatives, extrapolate)
    return jnp.stack([jnp.stack(each, axis=-1) for each in weights])


def basis_functions(
    knots: Float[Array, " knots"],
    order: int,
    u: ArrayLike,
    derivative: int = 0,
    *,
    extrapolate: bool = False,
) -> Float[Array, "*shape order"]:
    r"""The basis functions that do not vanish at `u`, or one of their derivatives.

    Entry $r$ belongs to control point $l - K + 1 + r$, $l$ = `find_span(knots, order, u)`,
    $K$ = `order` (equations (2)-(3) of the paper; NURBS Book, algorithms A2.2 and A2.3).

    Parameters
    ----------
    knots : array (count + order,)
        Non-decreasing, each interior knot at most `order` times. Not checked here.
    order : int
        Degree + 1, at least 1.
    u : array, any shape
    derivative : int
        How often to differentiate; from `order` on the result is zero.
    extrapolate : bool
        Whether parameters outside the domain continue the end pieces (True) or are first moved
        to the nearest end (False).
    """
    return _stacked(knots, order, as_parameters(u, knots), (derivative,), extrapolate)[0]


def basis_derivatives(
    knots: Float[Array, " knots"],
    order: int,
    u: ArrayLike,
    count: int,
    *,
    extrapolate: bool = False,
) -> Float[Array, "derivatives *shape order"]:
    """The non-vanishing basis functions and their first `count` derivatives, shape
    (count + 1, ..., order); otherwise as `basis_functions`."""
    return _stacked(knots, order, as_parameters(u, knots), tuple(range(count + 1)), extrapolate)


def as_parameters(u: ArrayLike, like: Array) -> Array:
    """`u` as a floating array of at least the precision of `like`."""
    u = jnp.asarray(u)
    if jnp.issubdtype(u.dtype, jnp.complexfloating):
        raise TypeError(f"parameters must be real, but have dtype {u.dtype}; pass real numbers.")
    return u.astype(jnp.result_type(u, like))
