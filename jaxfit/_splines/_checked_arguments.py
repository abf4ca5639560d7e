"""Checks of control points and knots."""

import operator
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxfit._checks import as_floating, check_knots, is_concrete
from jaxfit._splines._basis import as_parameters

LOWEST_ORDER, HIGHEST_ORDER = 2, 8


def checked_net(control_points: ArrayLike, knots: dict[str, ArrayLike]) -> tuple[Array, dict[str, Array]]:
    """The net and its named knot vectors (one per direction) as JAX arrays of one dtype."""
    net = as_floating("control_points", control_points, len(knots) + 1)
    if net.shape[-1] < 1:
        raise ValueError(
            f"control_points must have at least one coordinate, but has shape {net.shape}; "
            "put the coordinates in the last axis."
        )
    vectors = {name: as_floating(name, vector, 1) for name, vector in knots.items()}
    for (name, vector), count in zip(vectors.items(), net.shape[:-1], strict=True):
        order = vector.shape[0] - count
        if not LOWEST_ORDER <= order <= HIGHEST_ORDER:
            raise ValueError(
                f"{name} must hold {count} + order knots for {count} control points with an order "
                f"(degree + 1) of {LOWEST_ORDER} to {HIGHEST_ORDER}, but holds {vector.shape[0]}; "
                "change the number of knots or of control points."
            )
        if count < order:
            raise ValueError(
                f"control_points must number at least the order {order} along {name}, but there "
                f"are {count}; add control points or lower the order."
            )
        check_knots(name, vector, order, count)
    # asarray first: it follows the session's precision without a warning, astype would warn.
    arrays = [x if isinstance(x, jax.Array) else jnp.asarray(x) for x in (net, *vectors.values())]
    dtype = jnp.result_type(*arrays)
    net, *rest = (x if x.dtype == dtype else x.astype(dtype) for x in arrays)
    return net, dict(zip(vectors, rest, strict=True))


def paired_parameters(u: ArrayLike, v: ArrayLike, like: Array) -> tuple[Array, Array]:
    """`u` and `v` broadcast to one shape and one floating dtype."""
    a, b = as_parameters(u, like), as_parameters(v, like)
    if a.shape == b.shape and a.dtype == b.dtype:
        return a, b
    try:
        shape = np.broadcast_shapes(a.shape, b.shape)
    except ValueError as error:
        raise ValueError(
            f"u and v must have equal or broadcastable shapes, but have {a.shape} and {b.shape}; "
            "for all combinations of two lists use grid(us, vs)."
        ) from error
    dtype = jnp.result_type(a, b)
    return jnp.broadcast_to(a, shape).astype(dtype), jnp.broadcast_to(b, shape).astype(dtype)


def checked_derivative(name: str, count: Any) -> int:
    """How often to differentiate, as an int."""
    try:
        count = operator.index(count)
    except TypeError as error:
        raise TypeError(
            f"{name} must be a whole number known before tracing, but is {count!r}; pass an int."
        ) from error
    if count < 0:
        raise ValueError(f"{name} must not be negative, but is {count}; pass 0 for the value.")
    return count


def checked_new_knots(name: str, new_knots: ArrayLike | Sequence[float], knots: Array, order: int) -> Array:
    """Knots to insert as a floating vector inside the domain of `knots`."""
    if isinstance(new_knots, Sequence):
        new_knots = jnp.asarray(new_knots, knots.dtype)
    values = as_floating(name, new_knots, 1)
    if is_concrete(values, knots) and values.size:
        low, high = float(np.min(values)), float(np.max(values))
        start, stop = np.asarray(knots)[[order - 1, -order]]
        if low < start or high > stop:
            raise ValueError(
                f"{name} must lie in the domain [{start:g}, {stop:g}], but reaches from {low:g} "
                f"to {high:g}; drop the knots outside."
            )
    return jnp.asarray(values)
