"""Sums over rows, a block of them at a time, so that what a block needs stays in a core's caches."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxfit._cells._rows import Rows
from jaxfit._unrolling import unrolled
from jaxfit._varying import as_varying

# On a CPU, what a block computes stays in the caches. Elsewhere everything goes at once.
SLOTS_PER_BLOCK = 4096

Total = TypeVar("Total")


def sum_over_blocks(
    rows: Rows, add: Callable[[Rows, Array, Any], Total], begin: Total, slots: int = SLOTS_PER_BLOCK
) -> Total:
    """`add(block, filled, total)` for one block of rows after the other, from `begin`.

    `filled` are the slots of a block that hold a point which has not been seen before: the last block
    is moved back where fewer rows are left.
    """
    if unrolled():
        return add(rows, rows.filled, begin)
    count, width = rows.point.shape
    on_cpu = jax.default_backend() == "cpu"
    size = min(count, max(slots // width, 1)) if on_cpu else count

    def block(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        start, total = carry
        part = rows.block(start, size)
        fresh = jnp.arange(size) + jnp.minimum(start, count - size) >= start
        return start + size, add(part, part.filled & fresh[:, None], total)

    first = jnp.asarray(0, jnp.int32), as_varying(begin, begin, rows)
    return lax.while_loop(lambda x: x[0] < rows.used, block, first)[1]
