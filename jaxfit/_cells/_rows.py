"""Points in rows of one cell.

Points are sorted by cell and every cell's points are cut into rows of a fixed width, the last of them
partly empty. A row belongs to one cell, so the cell's polynomial is broadcast along it and evaluating is
plain vector arithmetic, with no gather per point. The number of rows is bounded by points / width +
cells whatever the distribution, so shapes stay static while points wander.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int


class Rows(eqx.Module):
    """Where every point sits: `point[row, slot]` is its number, or `points` for an empty slot."""

    cell: Int[Array, " rows"]
    point: Int[Array, "rows width"]
    slot_of_point: Int[Array, " points"]

    @property
    def filled(self) -> Bool[Array, "rows width"]:
        """Which slots hold a point."""
        return self.point < self.slot_of_point.shape[0]

    def spread(self, x: Float[Array, "d points"]) -> Float[Array, "d rows width"]:
        """Per-point values, laid out in rows; empty slots hold some point's value, never NaN."""
        return x[:, jnp.minimum(self.point, x.shape[1] - 1)]


def row_width(points: int, cells: int) -> int:
    """Width that keeps rows well filled: about half the mean number of points in a cell."""
    mean = points / max(cells, 1)
    return 8 if mean < 24 else 16 if mean < 400 else 32


def make_rows(cell: Int[Array, " points"], cells: int, width: int) -> Rows:
    """Sort points by their cell number and cut them into rows; numbers >= cells take no part."""
    points = cell.shape[0]
    count = points // width + min(cells, points)
    ordered, order = sort_by_cell(cell, cells)
    start = jnp.searchsorted(ordered, jnp.arange(cells + 1, dtype=ordered.dtype)).astype(jnp.int32)
    per_cell = -((start[:-1] - start[1:]) // width)
    first_row = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(per_cell, dtype=jnp.int32)])
    # Rows to points: row r of cell c holds sorted positions start[c] + (r - first_row[c]) * width ...
    row = jnp.arange(count, dtype=jnp.int32)
    owner = jnp.searchsorted(first_row, row, side="right").astype(jnp.int32) - 1
    owner = jnp.minimum(owner, cells - 1)
    begin = start[owner] + (row - first_row[owner]) * width
    position = begin[:, None] + jnp.arange(width, dtype=jnp.int32)[None, :]
    holds = (position < start[owner + 1][:, None]) & (row < first_row[-1])[:, None]
    point = jnp.where(holds, order[jnp.clip(position, 0, points - 1)], points)
    # ... and points to slots, the inverse.
    home = jnp.minimum(ordered, cells - 1).astype(jnp.int32)
    offset = jnp.arange(points, dtype=jnp.int32) - start[home]
    slot = first_row[home] * width + offset
    slot = jnp.clip(slot, 0, count * width - 1)
    slot_of_point = jnp.zeros(points, jnp.int32).at[order].set(slot, unique_indices=True)
    return Rows(owner, point, slot_of_point)


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
    word = _word(bits + cells.bit_length())
    if word is None:
        ordered, order = lax.sort((cell.astype(jnp.int32), number), num_keys=1, is_stable=True)
        return ordered, order
    packed = jnp.sort((cell.astype(word) << bits) | number.astype(word))
    mask = jnp.asarray((1 << bits) - 1, word)
    return (packed >> bits).astype(jnp.int32), (packed & mask).astype(jnp.int32)


def _word(bits: int):
    """The unsigned integer type with this many bits, if there is one at the current precision."""
    if bits <= 32:
        return jnp.uint32
    return jnp.uint64 if jax.config.read("jax_enable_x64") else None
