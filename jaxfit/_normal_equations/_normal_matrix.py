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

from jaxfit._cells import Rows, overlap_add, row_moments
from jaxfit._normal_equations._stencil import Stencil, shifted_slices
from jaxfit._splines._pieces import Axis
from jaxfit._unrolling import unrolled
from jaxfit._varying import as_varying

# On a CPU, powers and moments of so many points stay in a core's caches. Elsewhere all go at once.
SLOTS_AT_ONCE = 4096


def normal_stencil(
    rows: Rows,
    s: Float[Array, "rows width"],
    t: Float[Array, "rows width"],
    weight: Float[Array, "rows width"],
    axis_u: Axis,
    axis_v: Axis,
) -> Stencil:
    """sum_k w_k N_i N_i' (u_k) N_j N_j' (v_k) for all pairs of control points; empty slots have weight 0."""
    orders = 2 * _order(axis_u) - 1, 2 * _order(axis_v) - 1
    moments = cell_moments(rows, s, t, weight[None], orders, axis_u.cells * axis_v.cells)
    return Stencil(entries_of_moments(moments[..., None], axis_u, axis_v)[0])


def cell_moments(
    rows: Rows,
    s: Float[Array, "rows width"],
    t: Float[Array, "rows width"],
    values: Float[Array, "c rows width"],
    orders: tuple[int, int],
    cells: int,
) -> Float[Array, "cells A Bc"]:
    """Sums over each cell of s^a t^b x, laid out as by `row_moments`; empty slots have values 0."""
    count, width = s.shape
    size = min(count, max(SLOTS_AT_ONCE // width, 1)) if jax.default_backend() == "cpu" else count

    def block(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        start, total = carry
        begin = jnp.minimum(start, count - size)
        cell, x, y = (lax.dynamic_slice_in_dim(z, begin, size) for z in (rows.cell, s, t))
        value = lax.dynamic_slice_in_dim(values, begin, size, axis=1)
        # The last block overlaps the one before, whose rows have been added up.
        fresh = begin + jnp.arange(size, dtype=jnp.int32) >= start
        value = jnp.where(fresh[None, :, None], value, 0.0)
        return start + size, total.at[cell].add(row_moments(x, y, value, *orders))

    nothing = jnp.zeros((cells, orders[0], orders[1] * values.shape[0]), s.dtype)
    if unrolled():
        return nothing.at[rows.cell].add(row_moments(s, t, values, *orders))
    nothing = as_varying(nothing, rows, values)
    return lax.while_loop(lambda x: x[0] < rows.used, block, (jnp.asarray(0, jnp.int32), nothing))[1]


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
    neighbours = xp.moveaxis(shifted_slices(shifted, order, order, 1), 0, 2)
    return overlap_add(xp.moveaxis(basis, 2, 0)[:, :, :, None, None] * neighbours[None], -1)


def _order(axis: Axis) -> int:
    return int(np.shape(axis.polynomials)[1])
