"""The normal matrix A^T W A of a cloud, from the moments of its points within cells.

Within a cell the product of two basis functions is a polynomial of degree 2K - 2 in s, so all entries that
the cell contributes are linear images of its (2K - 1) x (2L - 1) moments sum_k w_k s_k^a t_k^b: 49 sums
for each point of a bicubic fit instead of 256, and no scatter to the net.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells import Rows
from jaxfit._normal_equations._stencil import Stencil, overlap_add, windows
from jaxfit._splines._pieces import Axis

# Powers of so many points are held at once, 112 bytes each for bicubic: within the caches' reach, and large
# enough for several cores.
SLOTS_AT_ONCE = 1 << 17


def normal_stencil(
    rows: Rows,
    s: Float[Array, "rows width"],
    t: Float[Array, "rows width"],
    weight: Float[Array, "rows width"],
    axis_u: Axis,
    axis_v: Axis,
) -> Stencil:
    """sum_k w_k N_i N_i' (u_k) N_j N_j' (v_k) for all pairs of control points, empty slots having weight 0.

    Memory: O(points), whatever the net.
    """
    cells, size = axis_u.cells * axis_v.cells, (2 * _order(axis_u) - 1, 2 * _order(axis_v) - 1)
    at_once = max(SLOTS_AT_ONCE // s.shape[1], 1)
    if s.shape[0] <= at_once:
        moments = _cell_moments(rows.cell, s, t, weight, size, cells)
    else:
        moments = _in_blocks(rows, s, t, weight, size, cells, at_once)
    return Stencil(entries_of_moments(moments.reshape(cells, *size, 1), axis_u, axis_v)[0])


def _in_blocks(
    rows: Rows, s: Array, t: Array, weight: Array, size: tuple[int, int], cells: int, at_once: int
) -> Array:
    """Sums over one block of rows after the other. The last block overlaps the one before: rows that have
    been added up already weigh nothing there."""

    def block(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        start, total = carry
        begin = jnp.minimum(start, s.shape[0] - at_once)
        cell, x, y, w = (lax.dynamic_slice_in_dim(z, begin, at_once) for z in (rows.cell, s, t, weight))
        fresh = begin + jnp.arange(at_once, dtype=jnp.int32) >= start
        w = jnp.where(fresh[:, None], w, 0.0)
        return start + at_once, total + _cell_moments(cell, x, y, w, size, cells)

    nothing = jnp.zeros((cells, size[0] * size[1]), s.dtype)
    begin = (jnp.asarray(0, jnp.int32), nothing)
    return lax.while_loop(lambda x: x[0] < rows.used, block, begin)[1]


def _cell_moments(
    cell: Array, s: Array, t: Array, weight: Array, size: tuple[int, int], cells: int
) -> Float[Array, "cells moments"]:
    """Broadcast products, summed along the row, then rows of one cell added up."""
    powers_s, powers_t = powers(s, size[0]), weight[None] * powers(t, size[1])
    sums = jnp.sum(powers_s[:, None] * powers_t[None, :], axis=-1)
    sums = sums.reshape(size[0] * size[1], -1).T
    return jax.ops.segment_sum(sums, cell, cells)


def powers(x: Float[Array, "rows width"], count: int) -> Float[Array, "count rows width"]:
    """1, x, x^2, ..."""
    each = [jnp.ones_like(x)]
    for _ in range(count - 1):
        each.append(each[-1] * x)
    return jnp.stack(each)


def entries_of_moments(
    moments: Float[Array, "cells A B m"], axis_u: Axis, axis_v: Axis
) -> Float[Array, "m K L nu nv"]:
    """Entries of a stencil for each of m weights, from the cells' (2K - 1) x (2L - 1) moments.

    One direction at a time: moments into entries for the basis functions of a span, then spans overlapped.
    """
    x = moments.reshape(axis_u.cells, axis_v.cells, *moments.shape[1:])
    along_u = jnp.einsum("prea,pqabm->rpeqbm", basis_products(axis_u), x, precision="highest")
    x = overlap_add(along_u, 0)
    along_v = jnp.einsum("qsfb,ieqbm->sqfiem", basis_products(axis_v), x, precision="highest")
    return overlap_add(along_v, 0).transpose(4, 3, 1, 2, 0)


def basis_products(axis: Axis) -> Float[Any, "cells K K moments"]:
    """N_r N_(r + e) of every span as polynomials, `[span, r, e]`; zero where r + e has no function there."""
    basis = axis.polynomials
    order = _order(axis)
    xp: Any = np if isinstance(basis, np.ndarray) else jnp
    shifted = xp.pad(basis, ((0, 0), (0, order - 1), (0, 0)))
    neighbours = xp.moveaxis(windows(shifted, order, order, 1), 0, 2)
    return overlap_add(xp.moveaxis(basis, 2, 0)[:, :, :, None, None] * neighbours[None], -1)


def _order(axis: Axis) -> int:
    return int(np.shape(axis.polynomials)[1])
