"""`materialise`: a barrier that keeps XLA from fusing parts of a computation."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxfit._varying import as_varying, varying_axes


def materialise(always: Array, function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`, computed once and stored.

    XLA's CPU compiler copies an expression into each of its uses, which multiplies the work where one
    large expression has many; an optimisation barrier is dropped before that happens. A branch on a value
    known only at run time is a barrier that stays. `always` is that value: true, but not provably so.
    """
    shapes: list[Any] = []

    def first(*args: Any) -> Any:
        result = function(*args)
        shapes[:] = [jax.tree.map(jax.typeof, result)]
        return result

    def never(*args: Any) -> Any:
        # Handing on an argument needs no code; zeros would be a kernel each.
        some = {_kind(x): x for x in jax.tree.leaves(args)}
        like = shapes[0] if shapes else jax.eval_shape(function, *args)  # JAX traces branches in their order
        return jax.tree.map(lambda x: some.get(_kind(x), as_varying(jnp.zeros(x.shape, x.dtype), x)), like)

    return lax.cond(always, first, never, *args)


def _kind(x: Any) -> Any:
    return x.shape, x.dtype, varying_axes(x)
