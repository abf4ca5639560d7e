"""Local mode: which control points move, and which points are projected again (section 4.1)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._cells import cells_of
from jaxfit._splines._pieces import Pieces


class Region(eqx.Module):
    """`touched`: control points that move. `alive`: points on whose cell one of these has influence."""

    touched: Bool[Array, "nu nv"]
    alive: Bool[Array, " points"]


def region_of(
    pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"], poor: Bool[Array, " points"]
) -> Region:
    """The region of the points `poor`, given the feet (u, v) of all points.

    A control point is touched if it has influence on the cell of a poor point.
    """
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    order_u, order_v = pieces.order
    cell = cells_of(pieces, u, v)
    count = jax.ops.segment_sum(poor.astype(jnp.int32), cell, pieces.cells)
    cells = (count > 0).reshape(axis_u.cells, axis_v.cells)
    touched = _widened(_widened(cells, order_u, 0), order_v, 1)
    alive = _narrowed(_narrowed(touched, order_u, 0), order_v, 1)
    return Region(touched, alive.reshape(-1)[cell])


def _widened(cells: Array, order: int, axis: int) -> Array:
    """Control points with influence on one of `cells`: i to i + order - 1 have influence on cell i."""
    pads = [[(k, order - 1 - k) if i == axis else (0, 0) for i in range(2)] for k in range(order)]
    total = jnp.pad(cells, pads[0])
    for pad in pads[1:]:
        total = total | jnp.pad(cells, pad)
    return total


def _narrowed(touched: Array, order: int, axis: int) -> Array:
    """Cells on which a touched control point has influence."""
    count = touched.shape[axis] - order + 1
    total = jax.lax.slice_in_dim(touched, 0, count, axis=axis)
    for k in range(1, order):
        total = total | jax.lax.slice_in_dim(touched, k, k + count, axis=axis)
    return total
