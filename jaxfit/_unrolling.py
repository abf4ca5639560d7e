"""`unrolling`: traces a fit as a program whose every operation has a derivative in both modes.

Loops of unknown length, over blocks of points and in iterative solvers, have no derivative in reverse mode.
What contains one asks `unrolled()` and does without.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

_unrolled: ContextVar[bool] = ContextVar("_unrolled", default=False)


@contextmanager
def unrolling() -> Iterator[None]:
    """What is traced within is unrolled."""
    token = _unrolled.set(True)
    try:
        yield
    finally:
        _unrolled.reset(token)


def unrolled() -> bool:
    """Whether what is being traced is unrolled."""
    return _unrolled.get()


def constant(x: Any) -> Any:
    """`x` without its derivative where that is unrolled: what only helps, as a preconditioner, has none."""
    return lax.stop_gradient(x) if unrolled() else x


def without_influence(weight: Float[Array, " points"]) -> Bool[Array, " points"]:
    """Points that need not be looked at. For the derivative in a weight that is 0 they are."""
    return jnp.zeros(weight.shape, bool) if unrolled() else weight <= 0


def root(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square roots; where that is unrolled, with the derivative 0 at 0."""
    return root_with_slope(square) if unrolled() else jnp.sqrt(square)


def root_with_slope(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square roots, with the derivative 0 at 0."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
