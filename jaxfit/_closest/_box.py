"""Where feet may go, and the local coordinates of the cells they are in."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxfit._splines._pieces import Pieces


class Sides(NamedTuple):
    """Bounds on the parameters, and the local coordinates of the cell whose polynomial is evaluated.

    A rate is 1 over half the cell's width: multiplying is cheaper than dividing.
    """

    low_u: Array
    high_u: Array
    centre_u: Array
    half_u: Array
    rate_u: Array
    low_v: Array
    high_v: Array
    centre_v: Array
    half_v: Array
    rate_v: Array

    def local(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Local coordinates of parameters."""
        return (u - self.centre_u) * self.rate_u, (v - self.centre_v) * self.rate_v


class Box(eqx.Module):
    """`Sides` of slots in one array, of which each part of a computation fetches those that it needs."""

    sides: Float[Array, "10 *shape"]

    def apart(self) -> Sides:
        """One by one."""
        return Sides(*self.sides)


class RowBox(eqx.Module):
    """`Sides` of cells, or of rows that lie in them. Those of a row lie side by side, as they are fetched:
    any other order would be a copy for each part of a computation.
    """

    sides: Float[Array, "rows 10"]

    @staticmethod
    def of_cells(pieces: Pieces) -> "RowBox":
        """Of all the cells."""
        along_u, along_v = (
            jnp.concatenate([axis.bounds, 1.0 / axis.half[None]]).T for axis in (pieces.axis_u, pieces.axis_v)
        )
        cells = (pieces.axis_u.cells, pieces.axis_v.cells, 5)
        both = [jnp.broadcast_to(along_u[:, None], cells), jnp.broadcast_to(along_v[None], cells)]
        return RowBox(jnp.concatenate(both, axis=2).reshape(-1, 10))

    def of_rows(self, cell: Int[Array, " rows"]) -> "RowBox":
        """Of the cells of some rows."""
        return RowBox(self.sides[cell])

    def along_rows(self) -> Sides:
        """One by one, each with a last axis to broadcast along rows."""
        return Sides(*self.sides.T[..., None])

    def within(self, border: Sequence[Array]) -> Box:
        """With bounds no wider than (low_u, high_u, low_v, high_v), each a number or given for every slot."""
        box, (low_u, high_u, low_v, high_v) = self.along_rows(), border
        low_u, high_u = jnp.maximum(box.low_u, low_u), jnp.minimum(box.high_u, high_u)
        low_v, high_v = jnp.maximum(box.low_v, low_v), jnp.minimum(box.high_v, high_v)
        sides = box._replace(low_u=low_u, high_u=high_u, low_v=low_v, high_v=high_v)
        return Box(jnp.stack(jnp.broadcast_arrays(*sides)))
