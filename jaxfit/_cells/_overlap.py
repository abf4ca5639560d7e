"""Sums of what basis functions of neighbouring spans contribute."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfit._splines._pieces import Numbers


def overlap_add(terms: Sequence[Numbers] | Numbers, axis: int) -> Any:
    """The sum of the terms, each one place farther along `axis` than the one before.

    The result has len(terms) - 1 places more. An array counts as the sequence of its entries.
    """
    last, number = len(terms) - 1, axis % terms[0].ndim
    total: Any = 0.0
    for place, x in enumerate(terms):
        sides = [(place, last - place) if k == number else (0, 0) for k in range(x.ndim)]
        if isinstance(x, np.ndarray):
            total = total + np.pad(x, sides)
        else:
            total = total + lax.pad(x, jnp.zeros((), x.dtype), [(*side, 0) for side in sides])
    return total
