"""Sums of what basis functions of neighbouring spans contribute."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit._splines._pieces import Numbers


def overlap_add(terms: Sequence[Numbers] | Numbers, axis: int) -> Any:
    """The sum of the terms, each one place farther along `axis` than the one before.

    The result has len(terms) - 1 places more. An array counts as the sequence of its entries.
    """
    shape = list(terms[0].shape)
    size = shape[axis]
    shape[axis] += len(terms) - 1
    before: tuple[Any, ...] = (slice(None),) * (axis % len(shape))
    if isinstance(terms[0], np.ndarray):
        result = np.zeros(shape, terms[0].dtype)
        for place, x in enumerate(terms):
            result[(*before, slice(place, place + size))] += x
        return result
    total = jnp.zeros(shape, terms[0].dtype)
    for place, x in enumerate(terms):
        total = total.at[(*before, slice(place, place + size))].add(x)
    return total
