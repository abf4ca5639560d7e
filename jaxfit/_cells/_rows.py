"""Points in rows of one cell.

Points are sorted by cell and every cell's points are cut into rows of a fixed width, the last of them
partly empty. A row belongs to one cell, so the cell's polynomial is broadcast along it and evaluating is
plain vector arithmetic, with no gather per point. The number of rows is bounded by points / width +
cells whatever the distribution, so shapes stay static while points wander.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Int, Shaped

# Points get rows of their own where there are so many times fewer than cells.
SCATTERED = 4


class Rows(eqx.Module):
    """Where every point sits: `point[row, slot]` is its number, or `points` for an empty slot.

    The first `used` rows hold points, the others none. Points that take no part have no slot.
    """

    cell: Int[Any, " rows"]
    point: Int[Any, "rows width"]
    used: Int[Any, ""]
    points: int = eqx.field(static=True)

    @property
    def filled(self) -> Bool[Array, "rows width"]:
        """Which slots hold a point."""
        return self.point < self.points

    def spread(self, x: Shaped[Array, "d points"]) -> Shaped[Array, "d rows width"]:
        """Per-point values, laid out in rows; empty slots hold some point's value, never NaN."""
        return x.at[:, self.point].get(mode="clip", wrap_negative_indices=False)

    def block(self, start: Int[Array, ""], size: int) -> "Rows":
        """`size` of the rows (moved back where fewer are left)."""
        cell = lax.dynamic_slice_in_dim(self.cell, start, size)
        point = lax.dynamic_slice_in_dim(self.point, start, size)
        return Rows(cell, point, self.used, self.points)


def row_width(points: int, cells: int) -> int:
    """Width that keeps rows well filled: about half the mean number of points in a cell."""
    mean = points / max(cells, 1)
    return 8 if mean < 24 else 16 if mean < 400 else 32


def narrow_width(points: int, cells: int) -> int:
    """Three quarters of `row_width`: where work on a slot costs more than work on a row."""
    return 3 * row_width(points, cells) // 4


def row_count(points: int, cells: int, width: int) -> int:
    """Rows enough for any distribution of the points."""
    return points // width + min(cells, points)


def make_rows(cell: Int[Array, " points"], cells: int, width: int) -> Rows:
    """Sort points by their cell number and cut them into rows; numbers >= cells take no part.

    Where there are far fewer points than cells each gets a row of its own, which needs no sorting.
    """
    count = row_count(cell.shape[0], cells, width)
    few = jnp.sum(cell < cells) <= min(cells // SCATTERED, count)
    return lax.cond(
        few,
        lambda: _scattered_rows(cell, cells, width, count),
        lambda: _sorted_rows(cell, cells, width, count),
    )


def _sorted_rows(cell: Int[Array, " points"], cells: int, width: int, count: int) -> Rows:
    points = cell.shape[0]
    ordered, order = sort_by_cell(cell, cells)
    members = jnp.zeros(cells + 1, jnp.int32).at[jnp.minimum(cell, cells)].add(1)
    sizes = jnp.stack([members, -(-members // width)])
    until = jnp.cumsum(sizes, axis=1, dtype=jnp.int32)
    start, first_row = until - sizes
    # Sorted position p of cell c sits in slot (first row of c) * width + (p - first position of c).
    slot = jnp.arange(points, dtype=jnp.int32) + (first_row * width - start)[ordered]
    slot = jnp.where(ordered < cells, slot, jnp.iinfo(jnp.int32).max)
    owner = jnp.zeros(count, jnp.int32).at[slot // width].set(ordered, mode="drop")
    table = jnp.full(count * width, points, jnp.int32).at[slot].set(order, mode="drop")
    return Rows(owner, table.reshape(count, width), until[1, cells - 1], points)


def make_single_rows(cell: Int[Array, " points"], cells: int) -> Rows:
    """A row for each point that takes part, in the points' own order: no sorting, but no cell is shared."""
    return _scattered_rows(cell, cells, 1, cell.shape[0])


def _scattered_rows(cell: Int[Array, " points"], cells: int, width: int, count: int) -> Rows:
    """In each of the first rows one point."""
    points = cell.shape[0]
    taken = cell < cells
    until = jnp.cumsum(taken, dtype=jnp.int32)
    row = jnp.where(taken, until - 1, count)
    number = jnp.arange(points, dtype=jnp.int32)
    table = jnp.full((count, width), points, jnp.int32).at[row, 0].set(number, mode="drop")
    owner = jnp.zeros(count, jnp.int32).at[row].set(cell, mode="drop")
    return Rows(owner, table, until[points - 1], points)


def sort_by_cell(
    cell: Int[Array, " points"], cells: int
) -> tuple[Int[Array, " points"], Int[Array, " points"]]:
    """Sorted cell numbers and the points in that order, stable.

    One sort of integers that pack cell and point number, which is several times faster than a sort
    with a payload; that one remains for what does not fit a word.
    """
    points = cell.shape[0]
    bits = max(points - 1, 1).bit_length()
    number = jnp.arange(points, dtype=jnp.int32)
    packed_type = _packed_type(bits + cells.bit_length())
    cell = jnp.minimum(cell, cells)
    if packed_type is None:
        ordered, order = lax.sort((cell.astype(jnp.int32), number), num_keys=1, is_stable=True)
        return ordered, order
    packed = jnp.sort((cell.astype(packed_type) << bits) | number.astype(packed_type))
    mask = jnp.asarray((1 << bits) - 1, packed_type)
    return (packed >> bits).astype(jnp.int32), (packed & mask).astype(jnp.int32)


def _packed_type(bits: int):
    """The unsigned integer type with this many bits, if there is one at the current precision."""
    if bits <= 32:
        return jnp.uint32
    return jnp.uint64 if jax.config.read("jax_enable_x64") else None
