"""Many feet at once: the iteration along rows of points that share a cell.

Only the plain case is handled here: steps that do what they should. A foot whose distance grows, or that
does not settle, goes back to its start and is left to the safeguarded iteration of `_blocks`.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._cells import Rows, row_coefficients, row_width, rows_of, staged
from jaxfit._closest._feet import Box, Feet, measure_at, next_trial
from jaxfit._closest._steps import AbstractFootMethod
from jaxfit._splines._pieces import Pieces

STEPS_PER_SWEEP = 3
MOST_SWEEPS = 8
# Rows pay while many points are still on their way; the last few go one block at a time.
FEW = 24

ON_ITS_WAY, ARRIVED, LEFT_OUT = 0, 1, 2
# In units of a cell's half width.
INSIDE, NEAR = 1.0 + 1e-6, 2.0


class Plain(eqx.Module):
    """Feet without a memory: parameters, last squared distance, and how they stand."""

    u: Float[Array, "..."]
    v: Float[Array, "..."]
    f: Float[Array, "..."]
    state: Int[Array, "..."]


def sweep(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    idle: Bool[Array, " points"],
    tolerance: Array,
    noise: Array,
) -> Feet:
    """Iterate in rows until only one foot in FEW is on its way (or MOST_SWEEPS are spent).

    Between sweeps the rows are made anew, because feet change cells. Within one, a foot that has left its
    row's cell may go on a little way on the continued polynomial, which differs by third order from its
    neighbour; what counts is judged inside a cell only.
    """
    points = target.shape[1]
    width = row_width(points, pieces.cells)
    always = tolerance < jnp.inf

    def unfinished(carry: tuple[Array, Plain]) -> Array:
        count, feet = carry
        return (count < MOST_SWEEPS) & (jnp.sum(feet.state == ON_ITS_WAY) > points // FEW)

    def body(carry: tuple[Array, Plain]) -> tuple[Array, Plain]:
        count, feet = carry
        rows = rows_of(pieces, feet.u, feet.v, width, feet.state != ON_ITS_WAY)
        box, coefficients, here, there = staged(always, _lay_out, pieces, rows, target, feet)

        def inner(_: Any, x: Plain) -> Plain:
            return _advance(method, x, here, coefficients, box, tolerance, noise)

        there = lax.fori_loop(0, STEPS_PER_SWEEP, inner, there)
        back = jax.tree.map(lambda x: x.reshape(-1)[rows.slot_of_point], there)
        kept = feet.state != ON_ITS_WAY
        return count + 1, jax.tree.map(lambda a, b: jnp.where(kept, a, b), feet, back)

    state = jnp.where(idle, LEFT_OUT, ON_ITS_WAY).astype(jnp.int32)
    begin = Plain(u, v, jnp.full_like(u, jnp.inf), state)
    count, end = lax.while_loop(unfinished, body, (jnp.asarray(0, jnp.int32), begin))
    return _as_feet(pieces, end, u, v, count * STEPS_PER_SWEEP)


def _advance(
    method: AbstractFootMethod,
    feet: Plain,
    target: list[Array],
    coefficients: Array,
    box: Box,
    tolerance: Array,
    noise: Array,
) -> Plain:
    """One step of every foot that is on its way and in, or near, its row's cell."""
    always = tolerance < jnp.inf

    def propose(u: Array, v: Array) -> tuple[Array, Array, Array]:
        # Three results and no more: the compiler evaluates the polynomials once for each.
        first = measure_at(method)(u, v, target, coefficients, box)
        return *next_trial(method, False)(first, u, v, box, tolerance), first.f

    next_u, next_v, f = staged(always, propose, feet.u, feet.v)
    off_u = jnp.abs(feet.u - box.centre_u)
    off_v = jnp.abs(feet.v - box.centre_v)
    near = (off_u <= NEAR * box.half_u) & (off_v <= NEAR * box.half_v)
    inside = (off_u <= INSIDE * box.half_u) & (off_v <= INSIDE * box.half_v)
    goes = near & (feet.state == ON_ITS_WAY)
    judged = inside & (feet.state == ON_ITS_WAY)
    worse = f > feet.f + noise * (2.0 * jnp.sqrt(f) + noise)
    still = (next_u == feet.u) & (next_v == feet.v)
    after = jnp.where(worse, LEFT_OUT, jnp.where(still, ARRIVED, ON_ITS_WAY)).astype(jnp.int32)
    return Plain(
        jnp.where(goes, next_u, feet.u),
        jnp.where(goes, next_v, feet.v),
        jnp.where(judged, f, feet.f),
        jnp.where(judged, after, feet.state),
    )


def _as_feet(pieces: Pieces, end: Plain, u: Array, v: Array, steps: Array) -> Feet:
    """Arrived feet as they are; all others from their start, and so are those on a crease."""
    arrived = end.state == ARRIVED
    for axis, x in ((pieces.axis_u, end.u), (pieces.axis_v, end.v)):
        cell = axis.locate(x)
        arrived &= ~((x <= axis.low[cell]) & (axis.low[cell] > axis.breaks[0]))
        arrived &= ~((x >= axis.high[cell]) & (axis.high[cell] < axis.breaks[-1]))
    u, v = jnp.where(arrived, end.u, u), jnp.where(arrived, end.v, v)
    best = jnp.where(arrived, end.f, jnp.inf)
    spent = jnp.full(u.shape, steps, jnp.int32)
    return Feet.of(u, v, u, v, best, jnp.zeros_like(spent), spent, arrived, arrived)


def cell_box(pieces: Pieces, cell: Array) -> Box:
    """Bounds and local coordinates of cells given by number, with a last axis to broadcast along."""
    cell_u, cell_v = cell // pieces.axis_v.cells, cell % pieces.axis_v.cells
    parts = []
    for axis, index in ((pieces.axis_u, cell_u), (pieces.axis_v, cell_v)):
        parts.append([x[index][..., None] for x in (axis.low, axis.high, axis.centre, axis.half)])
    (low_u, high_u, centre_u, half_u), (low_v, high_v, centre_v, half_v) = parts
    return Box(low_u, high_u, low_v, high_v, centre_u, half_u, centre_v, half_v)


def _lay_out(pieces: Pieces, rows: Rows, target: Array, feet: Plain) -> tuple[Box, Array, list[Array], Plain]:
    """Everything that a sweep reads, in rows; empty slots are left out."""
    last = target.shape[1] - 1
    there = jax.tree.map(lambda x: x[jnp.minimum(rows.point, last)], feet)
    state = jnp.where(rows.filled, there.state, LEFT_OUT)
    there = eqx.tree_at(lambda x: x.state, there, state)
    coefficients = row_coefficients(pieces, rows)
    return cell_box(pieces, rows.cell), coefficients, list(rows.spread(target)), there
