"""Feet moved on in passes: points laid out in rows of one cell, a block of rows at a time.

A pass lays out the feet that are still going and takes a few steps with each, on the polynomial of the cell
it is in. Feet change cells, so the next pass lays them out anew; the first holds nearly all points, the
last ones a few stragglers.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells import (
    SLOTS_PER_BLOCK,
    Rows,
    in_line,
    make_rows,
    make_single_rows,
    row_coefficients,
    row_width,
)
from jaxfit._closest._box import Box, RowBox
from jaxfit._closest._creases import Home, at_home, cross_creases, home_cells
from jaxfit._closest._feet import ARRIVED, Apart, Feet, Limits, advance, is_going
from jaxfit._closest._steps import AbstractFootMethod
from jaxfit._splines._pieces import Pieces

# Where rows hold a single point, laying feet out anew costs less than moving some that have arrived.
STEPS_PER_PASS = 3
STEPS_ALONE = 1
# A block on a CPU is too little to be shared among cores, which costs more than it gains; whole clouds are
# shared instead.
ROWS_PER_BLOCK = 2048
# Below this many points, or points per cell, rows of several points are too empty to pay.
SHARED_FROM_POINTS = 4096
SHARED_FROM_FILL = 2

Border = tuple[Array, Array, Array, Array]  # low_u, high_u, low_v, high_v: of all points, or of each


def settle(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    feet: Feet,
    border: Border,
    limits: Limits,
) -> Feet:
    """Passes until no foot is going."""
    creased = pieces.axis_u.creased or pieces.axis_v.creased
    home = at_home(pieces, feet) if creased else None

    def unfinished(carry: tuple[Feet, Home | None]) -> Array:
        return jnp.any(is_going(carry[0], limits))

    def one(carry: tuple[Feet, Home | None]) -> tuple[Feet, Home | None]:
        feet, home = carry
        cell_u, cell_v = pieces.axis_u.locate(feet.u), pieces.axis_v.locate(feet.v)
        if home is not None:
            cell_u, cell_v = home_cells(pieces, home, cell_u, cell_v)
        cell = cell_u * pieces.axis_v.cells + cell_v
        rows = _rows(jnp.where(is_going(feet, limits), cell, pieces.cells), pieces.cells)
        moved = _pass(method, pieces, target, feet, rows, border, limits)
        return (moved, None) if home is None else cross_creases(pieces, feet, moved, home, limits)

    return lax.while_loop(unfinished, one, (feet, home))[0]


def _rows(cell: Array, cells: int) -> Rows:
    points = cell.shape[0]
    shared = points >= SHARED_FROM_POINTS and points >= SHARED_FROM_FILL * cells
    return make_rows(cell, cells, row_width(points, cells)) if shared else make_single_rows(cell, cells)


def _pass(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Array,
    feet: Feet,
    rows: Rows,
    border: Border,
    limits: Limits,
) -> Feet:
    """A few steps for every foot in a row."""
    count, width = rows.point.shape
    steps = STEPS_PER_PASS if width > 1 else STEPS_ALONE
    on_cpu = jax.default_backend() == "cpu"
    size = min(count, SLOTS_PER_BLOCK // width, ROWS_PER_BLOCK) if on_cpu else count
    boxes = RowBox.of_cells(pieces)

    def block(carry: tuple[Array, Feet]) -> tuple[Array, Feet]:
        start, feet = carry
        part = rows.block(start, size)
        coefficients = row_coefficients(pieces, part)
        here = [x if x.ndim == 0 else part.spread(x[None])[0] for x in border]
        box = boxes.of_rows(part.cell).within(here)
        # Stored, not broadcast anew in every loop over the slots: see `in_line`.
        box = Box(in_line(jnp.broadcast_to(box.sides, (10, *part.point.shape))))
        point, goal = in_line(part.point), in_line(part.spread(target))
        mine = Feet(in_line(part.spread(feet.real)), in_line(part.spread(feet.whole)))
        mine = mine.standing(jnp.where(in_line(part.filled), mine.state, ARRIVED))

        def unfinished(carry: tuple[Array, Apart]) -> Array:
            return (carry[0] < steps) & jnp.any(is_going(carry[1], limits))

        def step(carry: tuple[Array, Apart]) -> tuple[Array, Apart]:
            return carry[0] + 1, advance(method, carry[1], goal, coefficients, box, limits)

        moved = lax.while_loop(unfinished, step, (jnp.asarray(0, jnp.int32), mine.apart()))[1]
        mine = Feet.of(*moved)
        real = feet.real.at[:, point].set(mine.real, mode="drop")
        whole = feet.whole.at[:, point].set(mine.whole, mode="drop")
        return start + size, Feet(real, whole)

    return lax.while_loop(lambda x: x[0] < rows.used, block, (jnp.asarray(0, jnp.int32), feet))[1]
