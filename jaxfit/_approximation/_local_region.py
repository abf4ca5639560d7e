"""Local mode (section 4.1): `local_region`, the control points that move and the points projected again."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._cells import cells_of
from jaxfit._splines._pieces import Pieces


class LocalRegion(eqx.Module):
    """The control points that move, and the points on whose cell one of these has influence."""

    control_points: Bool[Array, "nu nv"]
    points: Bool[Array, " points"]


def local_region(
    pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"], exceeded: Bool[Array, " points"]
) -> LocalRegion:
    """The region of the points that `exceeded` the tolerance, given the feet (u, v) of all points.

    The control points are those that have influence on the cell of a point that `exceeded` the tolerance.
    """
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    order_u, order_v = pieces.order
    cell = cells_of(pieces, u, v)
    count = jax.ops.segment_sum(exceeded.astype(jnp.int32), cell, pieces.cells)
    cells = (count > 0).reshape(axis_u.cells, axis_v.cells)
    control_points = _control_points_over(_control_points_over(cells, order_u, 0), order_v, 1)
    points = _cells_under(_cells_under(control_points, order_u, 0), order_v, 1)
    return LocalRegion(control_points, points.reshape(-1)[cell])


def _control_points_over(cells: Array, order: int, axis: int) -> Array:
    """Control points with influence on one of `cells`: i to i + order - 1 have influence on cell i."""
    pads = [[(k, order - 1 - k) if i == axis else (0, 0) for i in range(2)] for k in range(order)]
    total = jnp.pad(cells, pads[0])
    for pad in pads[1:]:
        total = total | jnp.pad(cells, pad)
    return total


def _cells_under(control_points: Array, order: int, axis: int) -> Array:
    """Cells on which one of the control points has influence."""
    count = control_points.shape[axis] - order + 1
    total = jax.lax.slice_in_dim(control_points, 0, count, axis=axis)
    for k in range(1, order):
        total = total | jax.lax.slice_in_dim(control_points, k, k + count, axis=axis)
    return total
