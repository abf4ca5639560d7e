"""Rows that are kept while most points stay in their cells: sorting costs as much as evaluating.

A point that has left its row's cell gets a row of its own behind the others; where many have, or where those
rows become too many, all are sorted anew.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._cells._few import few_among, few_of, rows_of_few
from jaxfit._cells._layout import rows_of
from jaxfit._cells._rows import Rows, narrow_width, row_count
from jaxfit._splines._pieces import Pieces

ROOM = 8  # one row of its own for so many others, at most


class KeptRows(eqx.Module):
    """Rows from some iterations ago; `most` of them may be used before they are sorted anew.

    `net` is the size of the net that they belong to.
    """

    rows: Rows
    most: Int[Any, ""]
    net: Int[Any, "2"]

    @staticmethod
    def none(points: int, cells: int) -> "KeptRows":
        """Nothing to begin with."""
        width = narrow_width(points, cells)
        count, zero = row_count(points, cells, width), np.zeros((), np.int32)
        rows = Rows(np.zeros(count, np.int32), np.full((count, width), points, np.int32), zero, points)
        return KeptRows(rows, zero - 1, np.zeros(2, np.int32))

    def followed(
        self,
        pieces: Pieces,
        u: Float[Array, " points"],
        v: Float[Array, " points"],
        left_out: Bool[Array, " points"],
        moved: Bool[Array, " points"],
    ) -> "KeptRows":
        """Rows for points with parameters (u, v), where only those that have `moved` may have left theirs."""
        points = u.shape[0]
        moved = moved & ~left_out
        count = jnp.sum(moved, dtype=jnp.int32)
        net = jnp.stack([jnp.asarray(a.used, jnp.int32) for a in (pieces.axis_u, pieces.axis_v)])
        stale = (count > few_among(points)) | (self.rows.used + count > self.most) | jnp.any(net != self.net)

        def sorted_anew() -> KeptRows:
            rows = rows_of(pieces, u, v, self.rows.point.shape[1], left_out)
            room = jnp.minimum(rows.used + rows.used // ROOM, rows.cell.shape[0])
            return KeptRows(rows, room.astype(jnp.int32), net)

        def regrouped() -> KeptRows:
            old = self.rows
            alone = rows_of_few(pieces, u, v, few_of(moved, few_among(points)), count)
            own = jnp.arange(alone.cell.shape[0], dtype=jnp.int32)
            own = jnp.where(own < count, own + old.used, old.cell.shape[0])
            gone = jnp.concatenate([moved, jnp.zeros(1, bool)])
            point = jnp.where(gone[old.point], points, old.point)
            point = point.at[own, 0].set(alone.point[:, 0], mode="drop")
            cell = old.cell.at[own].set(alone.cell, mode="drop")
            return KeptRows(Rows(cell, point, old.used + count, points), self.most, self.net)

        return lax.cond(stale, sorted_anew, regrouped)
