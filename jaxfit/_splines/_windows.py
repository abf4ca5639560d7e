"""Runs of consecutive entries, gathered in one operation."""

from typing import Any

import numpy as np
from jax import lax


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
