"""How error vectors pull on control points: the sums of Algorithm 1, in one pass over the points.

Points lie in rows of one cell, and a block of rows at a time is evaluated, moved and summed, so that what
it needs stays in a core's caches.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._foot_updates import AbstractFootMove, Moved
from jaxfit._barrier import materialise
from jaxfit._cells import (
    SLOTS_PER_BLOCK,
    Rows,
    cells_to_net,
    few_among,
    few_of,
    in_line,
    in_rows,
    narrow_width,
    over_blocks,
    row_moments,
    rows_of,
    rows_of_few,
)
from jaxfit._closest import RowBox
from jaxfit._splines._pieces import Pieces

SLOTS_AGAIN = 256  # of a block of the few points that are looked at again, each in a row of its own


class Pulls(eqx.Module):
    """What a pass over the points gives: sum_k w_k N_i N_j e_k and, last, sum_k w_k N_i N_j."""

    sums: Float[Any, "nu nv c"]

    @property
    def means(self) -> Float[Array, "nu nv d"]:
        """Weighted means of the error vectors around each control point, 0 where no point pulls."""
        total = self.sums[..., -1:]
        touched = total > 0
        return jnp.where(touched, self.sums[..., :-1] / jnp.where(touched, total, 1.0), 0.0)


class Pulled(NamedTuple):
    """Feet and how they pull."""

    feet: Float[Array, "3 points"]  # u, v and the length of the residual
    looks: Int[Array, " points"]  # until the foot was certain, 0 where that failed
    gone: Bool[Array, " points"]  # out of the cell of the row that held the point at first
    pulls: Pulls
    active: Int[Array, ""]  # how many points pull


class _Pass(eqx.Module):
    """`feet` are u, v, the length of the residual, and a mark: the number of the look that found the foot,
    or 0, and if it has left its first cell half more, or -1.
    """

    feet: Float[Array, "4 points"]
    cells: Float[Array, "cells K Lc"]

    @property
    def found(self) -> Bool[Array, " points"]:
        """Which feet are certain."""
        return self.feet[3] > 0


def _gone(mark: Array) -> Array:
    return (mark < 0) | (mark > jnp.floor(mark))


def pull(
    problem: Any,
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    error: Float[Array, " points"],
    idle: Bool[Array, " points"],
    weigh: Callable[[Array, Array], Array],
    move: AbstractFootMove,
    rows: Rows | None = None,
) -> Pulled:
    """Where the feet go, and the sums there.

    `idle` points have no part in it, and keep the `error` they have. `weigh(weight, error)` says how much
    points pull, each at the foot that it has after the `move`; those whose feet are not certain do not.
    `rows` hold all points that are not idle.
    """
    pieces = jax.tree.map(jnp.asarray, pieces)
    order_u, order_v = pieces.order
    begin = _Pass(
        jnp.stack([u, v, error, jnp.zeros_like(u)]),
        jnp.zeros((pieces.cells, order_u, order_v * (problem.target.shape[0] + 1)), u.dtype),
    )
    one = partial(_one_pass, problem, pieces, weigh, move, move.prepare(problem, pieces))
    if rows is None:
        rows = rows_of(pieces, u, v, narrow_width(u.shape[0], pieces.cells), idle)
    if move.looks == 1:
        done = one(rows, SLOTS_PER_BLOCK, 1, begin)
    else:
        done = _in_looks(one, pieces, idle, rows, move.looks, begin)
    sums = cells_to_net(done.cells, pieces.axis_u.polynomials, pieces.axis_v.polynomials)
    sums = _above_rounding(sums, pieces.order)
    active = jnp.sum((weigh(problem.weight, done.feet[2]) > 0) & done.found, dtype=jnp.int32)
    looks = jnp.maximum(done.feet[3], 0.0).astype(jnp.int32)
    return Pulled(done.feet[:3], looks, _gone(done.feet[3]), Pulls(sums), active)


def _above_rounding(sums: Array, order: tuple[int, int]) -> Array:
    """Sums of weights, and what goes with them, that are not so small that rounding decides them.

    What rounds a sum is as large as those of the control points with which it shares a cell.
    """
    total = lax.stop_gradient(sums[..., -1:])
    largest = total
    for window in ((2 * order[0] - 1, 1, 1), (1, 2 * order[1] - 1, 1)):
        largest = lax.reduce_window(largest, 0.0, lax.max, window, (1, 1, 1), "SAME")
    return jnp.where(total > jnp.finfo(sums.dtype).eps ** 0.75 * largest, sums, 0.0)


def _in_looks(one: Any, pieces: Pieces, idle: Array, rows: Rows, most: int, begin: _Pass) -> _Pass:
    """Passes over those points whose feet are not certain yet, from where the last pass has left them.

    The first has `rows`. Later ones lay out anew what is left, few points each in a row of its own. Of these
    two layouts one is empty, which costs nothing, while a branch would copy all that is carried.
    """

    def left(done: _Pass) -> Array:
        return ~idle & ~done.found

    few = few_among(idle.shape[0])

    def unfinished(carry: tuple[Array, _Pass]) -> Array:
        return (carry[0] < most) & jnp.any(left(carry[1]))

    def another(carry: tuple[Array, _Pass]) -> tuple[Array, _Pass]:
        look, done = carry[0] + 1, carry[1]
        mine, (u, v) = left(done), done.feet[:2]
        count, first = jnp.sum(mine, dtype=jnp.int32), look == 1
        many = first | (count > few)

        def anew() -> Rows:
            return rows_of(pieces, u, v, rows.point.shape[1], ~mine)

        def none() -> Rows:
            return Rows(rows.cell, rows.point, jnp.zeros_like(rows.used), rows.points)

        shared = lax.cond(first, lambda: rows, lambda: lax.cond(many, anew, none))
        done = one(shared, SLOTS_PER_BLOCK, look, done)
        alone = rows_of_few(pieces, u, v, few_of(mine, few), jnp.where(many, 0, count))
        return look, one(alone, SLOTS_AGAIN, look, done)

    return lax.while_loop(unfinished, another, (jnp.asarray(0, jnp.int32), begin))[1]


def _one_pass(
    problem: Any,
    pieces: Pieces,
    weigh: Callable[[Array, Array], Array],
    move: AbstractFootMove,
    ready: Any,
    rows: Rows,
    slots: int,
    look: Any,
    begin: _Pass,
) -> _Pass:
    """Move the feet in `rows` from where they are, and add up how they pull."""
    (order_u, order_v), always = pieces.order, problem.diagonal > 0
    boxes = RowBox.of_cells(pieces)

    def add(part: Rows, filled: Array, done: _Pass) -> _Pass:
        box = boxes.of_rows(part.cell)
        target, feet, given = (
            in_line(part.spread(x)) for x in (problem.target, done.feet, problem.weight[None])
        )
        moved = move(problem, pieces, ready, part, box, target, *feet[:2])
        error = materialise(always, lambda e: jnp.sqrt(sum(x * x for x in e)), moved.e)

        def summands(
            old: tuple[Array, Array], new: Moved, error: Array, given: Array, box: RowBox
        ) -> tuple[Array, Array, Array]:
            pulls = new.certain
            weight = jnp.where(pulls, weigh(given, error), 0.0)
            values = jnp.concatenate([weight[None] * jnp.where(pulls[None], new.e, 0.0), weight[None]])
            # A foot that is not certain may not even be a number.
            u, v = (jnp.where(pulls, x, y) for x, y in zip((new.u, new.v), old, strict=True))
            s, t = box.along_rows().local(u, v)
            # A foot that leaves its cell pulls from the cell's edge this once.
            return jnp.clip(s, -1.0, 1.0), jnp.clip(t, -1.0, 1.0), values

        pulling = moved._replace(certain=in_line(filled) & moved.certain)
        x = ((feet[0], feet[1]), pulling, error, given[0])
        x = jax.tree.map(lambda y: in_rows(y, part.cell.shape[0]), x)
        s, t, values = materialise(always, summands, *x, box)
        moments = row_moments(s, t, values, order_u, order_v)
        gone = (~moved.stays | _gone(feet[3])).astype(error.dtype)
        mark = jnp.where(moved.certain, look + 0.5 * gone, -gone)
        point = in_line(jnp.where(filled, part.point, part.points))
        feet = jnp.stack([moved.u, moved.v, error, mark])
        feet = done.feet.at[:, point].set(feet, mode="drop")
        return _Pass(feet, done.cells.at[part.cell].add(moments))

    return over_blocks(rows, add, begin, slots)
