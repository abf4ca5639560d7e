"""Look-ups in vectors: runs of consecutive entries, and places in sorted values."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

UNROLLED = 30  # terms of a sum


def windows(values: Any, first: Any, width: int) -> Any:
    """`values[first + i]` for i = 0, ..., width - 1, of shape (width, *first.shape, *rest).

    `values` is (n, *rest). All indices must lie inside: nothing checks them.
    """
    if isinstance(values, np.ndarray) and isinstance(first, np.ndarray):
        return values[np.arange(width).reshape(-1, *(1,) * first.ndim) + first]
    rest = values.shape[1:]
    dimensions = lax.GatherDimensionNumbers(
        offset_dims=(0, *range(first.ndim + 1, first.ndim + 1 + len(rest))),
        collapsed_slice_dims=(),
        start_index_map=(0,),
    )
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.gather(values, first[..., None], dimensions, (width, *rest), mode=mode)


def last_not_above(breaks: Float[Array | np.ndarray, " breaks"], u: Float[Array, "..."]) -> Int[Array, "..."]:
    """The last i with breaks[i] <= u, by counting: every so many breaks, then those between.

    Two short sums without memory between compile and run faster than bisection. The first costs least, up to
    the length that is compiled without a loop.
    """
    count = breaks.shape[0]
    stride = min(math.isqrt(count), -(-count // UNROLLED))
    first = _count_not_above(breaks[::stride].reshape(-1, *(1,) * u.ndim), u) - 1
    if stride == 1:
        return first
    first = jnp.maximum(first, 0) * stride
    padded = jnp.concatenate([breaks, np.full(stride, np.inf, breaks.dtype)])
    return first + _count_not_above(windows(padded, first + 1, stride - 1), u)


def _count_not_above(
    breaks: Float[Array | np.ndarray, "breaks *rest"], u: Float[Array, "..."]
) -> Int[Array, "..."]:
    """How many of the breaks are at most u, for one set of breaks or for a set of each u."""
    return lax.reduce((breaks <= u[None]).astype(np.int32), np.int32(0), lax.add, (0,))
