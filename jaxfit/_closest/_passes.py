"""Feet moved on in passes: points laid out in rows of one cell, a block of rows at a time.

A pass lays out the feet that are still going and takes a few steps with each, on the polynomial of the cell
it is in. Feet change cells, so the next pass lays them out anew; the first holds nearly all points, the
last ones a few stragglers.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells import Rows, make_rows, make_single_rows, row_width, sort_by_cell
from jaxfit._closest._creases import Home, at_home, cross_creases, home_cells
from jaxfit._closest._feet import ARRIVED, Box, Feet, Limits, advance, is_going
from jaxfit._closest._steps import AbstractFootMethod
from jaxfit._splines._pieces import Axis, Pieces

# Where rows hold a single point, laying feet out anew costs less than moving some that have arrived.
STEPS_PER_PASS = 3
STEPS_ALONE = 1
# On a CPU, what a block computes stays in the caches, and is too little to be shared among cores, which costs
# more than it gains; whole clouds are shared instead. Elsewhere everything goes at once.
SLOTS_PER_BLOCK = 4096
ROWS_PER_BLOCK = 2048
# Below this many points, or points per cell, rows of several points are too empty to pay.
SHARED_FROM_POINTS = 4096
SHARED_FROM_FILL = 2

# On a CPU, points that are laid out together, and more passes than any foot takes.
GROUP = 8192
MANY = 1 << 30

Border = tuple[Array, Array, Array, Array]  # low_u, high_u, low_v, high_v: of all points, or of each


def settle(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    feet: Feet,
    border: Border,
    limits: Limits,
    together: bool = False,
) -> Feet:
    """Passes until no foot is going.

    Each group of points gets a pass of its own, and after that those still going, from whichever group, go on
    together: few of them do, and they must not cost passes over all the others. Whether neighbours in
    memory are neighbours on the surface too can be said by `together`.
    """
    creased = pieces.axis_u.creased or pieces.axis_v.creased
    home = at_home(pieces, feet) if creased else None
    points = target.shape[1]
    shared = points >= SHARED_FROM_POINTS and points >= SHARED_FROM_FILL * pieces.cells
    width = row_width(points, pieces.cells) if shared else 1
    whole = jax.default_backend() != "cpu" or points <= 2 * GROUP
    if whole:
        everything = _Group(target, feet, home, border)
        return _passes(method, pieces, everything, limits, width, jnp.asarray(MANY, jnp.int32)).feet
    order = jnp.arange(points, dtype=jnp.int32)
    if shared and not together:
        cell_u, cell_v = pieces.axis_u.locate(feet.u), pieces.axis_v.locate(feet.v)
        order = sort_by_cell(cell_u * pieces.axis_v.cells + cell_v, pieces.cells)[1]
    groups = -(-points // GROUP)

    def unfinished(carry: tuple[Array, Feet, Home | None]) -> Array:
        return (carry[0] < groups) | jnp.any(is_going(carry[1], limits))

    def one(carry: tuple[Array, Feet, Home | None]) -> tuple[Array, Feet, Home | None]:
        number, feet, home = carry
        place = number * GROUP + jnp.arange(GROUP, dtype=jnp.int32)
        index = lax.cond(
            number < groups,
            lambda: order.at[place].get(mode="fill", fill_value=points),
            lambda: jnp.nonzero(is_going(feet, limits), size=GROUP, fill_value=points)[0].astype(jnp.int32),
        )
        safe = jnp.minimum(index, points - 1)
        mine = Feet(feet.real[:, safe], feet.whole[:, safe])
        mine = mine.standing(jnp.where(index < points, mine.state, ARRIVED))
        low_u, high_u, low_v, high_v = (x if x.ndim == 0 else x[safe] for x in border)
        bounds = (low_u, high_u, low_v, high_v)
        group = _Group(target[:, safe], mine, jax.tree.map(lambda x: x[safe], home), bounds)
        most = jnp.where(number < groups, 1, MANY)
        done = _passes(method, pieces, group, limits, width, most)

        def put(old: Array, new: Array) -> Array:
            return old.at[..., index].set(new, mode="drop")

        feet = Feet(put(feet.real, done.feet.real), put(feet.whole, done.feet.whole))
        return number + 1, feet, jax.tree.map(put, home, done.home)

    return lax.while_loop(unfinished, one, (jnp.asarray(0, jnp.int32), feet, home))[1]


class _Group(eqx.Module):
    """Points that are laid out together."""

    target: Float[Array, "d points"]
    feet: Feet
    home: Home | None
    border: Border


def _passes(
    method: AbstractFootMethod, pieces: Pieces, group: _Group, limits: Limits, width: int, most: Array
) -> _Group:
    """Up to so many passes over the feet of a group that are going."""

    def unfinished(carry: tuple[Array, Feet, Home | None]) -> Array:
        return (carry[0] < most) & jnp.any(is_going(carry[1], limits))

    def one(carry: tuple[Array, Feet, Home | None]) -> tuple[Array, Feet, Home | None]:
        number, feet, home = carry
        cell_u, cell_v = pieces.axis_u.locate(feet.u), pieces.axis_v.locate(feet.v)
        if home is not None:
            cell_u, cell_v = home_cells(pieces, home, cell_u, cell_v)
        cell = jnp.where(is_going(feet, limits), cell_u * pieces.axis_v.cells + cell_v, pieces.cells)
        alone = width == 1
        rows = make_single_rows(cell, pieces.cells) if alone else make_rows(cell, pieces.cells, width)
        moved = _pass(method, pieces, group.target, feet, rows, group.border, limits)
        if home is not None:
            moved, home = cross_creases(pieces, feet, moved, home, limits)
        return number + 1, moved, home

    begin = (jnp.asarray(0, jnp.int32), group.feet, group.home)
    _, feet, home = lax.while_loop(unfinished, one, begin)
    return _Group(group.target, feet, home, group.border)


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

    def block(carry: tuple[Array, Feet]) -> tuple[Array, Feet]:
        start, feet = carry
        part = rows.block(start, size)
        coefficients = jnp.moveaxis(pieces.coefficients[part.cell], 0, -1)[..., None]
        box = box_of(pieces, part.cell, [x if x.ndim == 0 else part.spread(x[None])[0] for x in border])
        goal = part.spread(target)
        mine = Feet(part.spread(feet.real), part.spread(feet.whole))
        mine = mine.standing(jnp.where(part.filled, mine.state, ARRIVED))

        def unfinished(carry: tuple[Array, Feet]) -> Array:
            return (carry[0] < steps) & jnp.any(is_going(carry[1], limits))

        def step(carry: tuple[Array, Feet]) -> tuple[Array, Feet]:
            return carry[0] + 1, advance(method, carry[1], goal, coefficients, box, limits)

        mine = lax.while_loop(unfinished, step, (jnp.asarray(0, jnp.int32), mine))[1]
        real = feet.real.at[:, part.point].set(mine.real, mode="drop")
        whole = feet.whole.at[:, part.point].set(mine.whole, mode="drop")
        return start + size, Feet(real, whole)

    return lax.while_loop(lambda x: x[0] < rows.used, block, (jnp.asarray(0, jnp.int32), feet))[1]


def box_of(pieces: Pieces, cell: Array, border: Sequence[Array]) -> Box:
    """Bounds and local coordinates of cells given by number, with a last axis to broadcast along."""
    low_u, high_u, centre_u, half_u = _bounds(pieces.axis_u, cell // pieces.axis_v.cells)
    low_v, high_v, centre_v, half_v = _bounds(pieces.axis_v, cell % pieces.axis_v.cells)
    return Box(
        jnp.maximum(low_u, border[0]),
        jnp.minimum(high_u, border[1]),
        jnp.maximum(low_v, border[2]),
        jnp.minimum(high_v, border[3]),
        centre_u,
        half_u,
        1.0 / half_u,
        centre_v,
        half_v,
        1.0 / half_v,
    )


def _bounds(axis: Axis, cell: Array) -> list[Array]:
    return [x[:, None] for x in axis.bounds[:, cell]]
