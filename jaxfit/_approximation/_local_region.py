"""Local mode: where a fit goes on, and what it leaves alone (section 4.1 of the paper)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._cells import cells_of
from jaxfit._splines._pieces import Pieces


class Region(eqx.Module):
    """The control points that some poor point touches, and the points that feel these move."""

    touched: Bool[Array, "nu nv"]
    alive: Bool[Array, " points"]


def region_of(
    pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"], poor: Bool[Array, " points"]
) -> Region:
    """Of the points `poor` with feet (u, v).

    A control point is touched if it has influence on the cell of a poor point, and a point feels it if it has
    influence on that point's cell.
    """
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    order_u, order_v = pieces.order
    cell = cells_of(pieces, u, v)
    count = jax.ops.segment_sum(poor.astype(jnp.int32), cell, pieces.cells)
    cells = (count > 0).reshape(axis_u.cells, axis_v.cells)
    touched = _widened(_widened(cells, order_u, 0), order_v, 1)
    felt = _narrowed(_narrowed(touched, order_u, 0), order_v, 1)
    return Region(touched, felt.reshape(-1)[cell])


def _widened(marks: Array, order: int, axis: int) -> Array:
    """Control points with influence on marked cells: i to i + order - 1 have some on cell i."""
    pads = [[(k, order - 1 - k) if i == axis else (0, 0) for i in range(2)] for k in range(order)]
    total = jnp.pad(marks, pads[0])
    for pad in pads[1:]:
        total = total | jnp.pad(marks, pad)
    return total


def _narrowed(marks: Array, order: int, axis: int) -> Array:
    """Cells under marked control points."""
    count = marks.shape[axis] - order + 1
    total = jax.lax.slice_in_dim(marks, 0, count, axis=axis)
    for k in range(1, order):
        total = total | jax.lax.slice_in_dim(marks, k, k + count, axis=axis)
    return total
