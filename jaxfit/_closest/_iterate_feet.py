"""Iterates feet in passes, with the points in rows of one cell, a block of rows at a time.

A pass sorts the feet that still move into rows and takes a few steps with each, on the polynomial of its
cell. Feet change cells, so the next pass sorts them anew. The first pass holds nearly all points, the last
ones very few. A caller's sums over the points are accumulated in the pass that finds their feet.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._cells import (
    Rows,
    make_rows,
    make_single_rows,
    narrow_width,
    row_coefficients,
    sum_over_blocks,
)
from jaxfit._closest._bounds import Bounds, bounds_of_cells, bounds_of_slots
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._foot_states import (
    FOUND,
    GOING,
    SUMMED_FOUND,
    SUMMED_GIVEN_UP,
    FootLimits,
    FootStates,
    is_going,
)
from jaxfit._closest._forms import either
from jaxfit._closest._safeguarded_step import Mode, MovingFeet, advance
from jaxfit._closest._smooth_regions import SmoothRegion, cells_of_regions, cross_creases, initial_region
from jaxfit._closest._taylor_projection import third_derivatives
from jaxfit._splines._pieces import Pieces
from jaxfit._varying import as_varying

# Steps in one pass where rows hold several points, as long as at least one foot in so many still moves.
STEPS_PER_PASS = 3
GOING_ONE_IN = 3
# A block on a CPU is too small to be divided among cores; whole clouds are divided instead.
ROWS_PER_BLOCK = 2048
# Smaller than the blocks of sums over all points: the few points of the last passes cost a whole block.
SLOTS_PER_BLOCK = 1024
# Below this many points, or points per cell, rows of several points are too empty to pay.
SHARED_FROM_POINTS = 4096
SHARED_FROM_FILL = 2


class PointSums(eqx.Module):
    """What to sum over the points at their feet."""

    @abstractmethod
    def begin(self, pieces: Pieces) -> Any:
        """The sums over no points, for each cell."""

    @abstractmethod
    def add(
        self,
        total: Any,
        part: Rows,
        s: Float[Array, "rows width"],
        t: Float[Array, "rows width"],
        e: Float[Array, "d rows width"],
        weight: Float[Array, "rows width"],
    ) -> Any:
        """With what some rows add: points with local coordinates (s, t) and residuals e = Q - R.

        Slots whose weight and residual are zero hold no point.
        """

    @abstractmethod
    def finish(self, total: Any, pieces: Pieces) -> Any:
        """What the caller gets."""


def iterate_feet(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    feet: FootStates,
    limits: FootLimits,
    within: Float[Array, "2 2 _"] | None = None,
    sums: PointSums | None = None,
    weight: Float[Array, " points"] | None = None,
    single_step: Any = False,
) -> tuple[FootStates, Any]:
    """Passes until no foot is going, and the sums.

    `within` are bounds narrower than the domain (lower and upper, u and v), of all points or of each. Feet
    that are not found take part in the sums by their best. With `single_step` every foot takes one step, and
    the residual that this predicts.
    """
    creased = pieces.axis_u.creased or pieces.axis_v.creased
    region = initial_region(pieces, feet) if creased else None
    total = None if sums is None else sums.begin(pieces)
    cells = bounds_of_cells(pieces, third_derivatives(pieces))

    def waiting(feet: FootStates) -> Bool[Array, " points"]:
        return is_going(feet, limits) if sums is None else feet.state < SUMMED_FOUND

    def one(
        carry: tuple[FootStates, SmoothRegion | None, Any],
    ) -> tuple[FootStates, SmoothRegion | None, Any]:
        feet, region, total = carry
        which, mode = is_going(feet, limits), None
        if sums is not None:  # a last pass adds the feet that have ended without being certified
            last = ~jnp.any(which)
            mode = Mode(last | single_step, last)
            which = (which | last) & waiting(feet)
            parts = feet.parts
            feet = FootStates(jnp.concatenate([jnp.where(last, parts[2:4], parts[:2]), parts[2:]]))
        u, v = feet.trial
        cell_u, cell_v = pieces.axis_u.locate(u), pieces.axis_v.locate(v)
        if region is not None:
            cell_u, cell_v = cells_of_regions(pieces, region, cell_u, cell_v)
        cell = jnp.where(which, cell_u * pieces.axis_v.cells + cell_v, pieces.cells)
        rows = _rows(cell, pieces.cells, sums is not None)
        one_pass = _Pass(method, pieces, target, cells, limits, within, sums, weight, mode)
        moved, total = one_pass(rows, feet, total)
        if region is not None:
            moved, region = cross_creases(pieces, feet, moved, region, limits)
        return moved, region, total

    begin = as_varying((feet, region, total), pieces, target, feet, weight)
    feet, _, total = lax.while_loop(lambda carry: jnp.any(waiting(carry[0])), one, begin)
    return feet, None if sums is None else sums.finish(total, pieces)


def _rows(cell: Array, cells: int, summed: bool) -> Rows:
    points = cell.shape[0]
    shared = points >= SHARED_FROM_FILL * cells and (summed or points >= SHARED_FROM_POINTS)
    return make_rows(cell, cells, narrow_width(points, cells)) if shared else make_single_rows(cell, cells)


class _Pass(eqx.Module):
    """A few steps for every foot in a row."""

    method: AbstractFootMethod
    pieces: Pieces
    target: Float[Array, "d points"]
    cells: Float[Array, "cells 11"]
    limits: FootLimits
    within: Float[Array, "2 2 _"] | None
    sums: PointSums | None
    weight: Float[Array, " points"] | None
    mode: Mode | None

    @property
    def creased(self) -> bool:
        """Whether feet may have to go on across a crease."""
        return self.pieces.axis_u.creased or self.pieces.axis_v.creased

    def __call__(self, rows: Rows, feet: FootStates, total: Any) -> tuple[FootStates, Any]:
        """All rows, a block of them after the other."""
        width = rows.point.shape[1]
        slots = min(SLOTS_PER_BLOCK, ROWS_PER_BLOCK * width)
        return sum_over_blocks(rows, self._block, (feet, total), slots)

    def _block(self, part: Rows, filled: Array, carry: tuple[FootStates, Any]) -> tuple[FootStates, Any]:
        feet, total = carry
        bounds, third = bounds_of_slots(self.cells, part, self.within)
        moving, takes_part, before = self._begin(part, filled, feet)
        moved = self._steps(part, moving, bounds, third)
        if self.sums is not None:
            moved, total = self._sum(part, takes_part, before, moved, bounds, total)
        parts = jnp.concatenate([*moved[:5]])[:, 0]
        point = jnp.where(takes_part[0, 0], part.point.reshape(-1), part.points)
        return FootStates(feet.parts.at[:, point].set(parts, mode="drop", wrap_negative_indices=False)), total

    def _begin(self, part: Rows, filled: Array, feet: FootStates) -> tuple[MovingFeet, Array, Array]:
        """The feet of a block, of which those that take part in this pass are going; and their states."""
        slots = part.point.size
        trial, best, f, steps, state = lax.split(
            part.spread(feet.parts).reshape(7, 1, slots), (2, 2, 1, 1, 1)
        )
        takes_part = filled.reshape(1, 1, slots)
        if self.mode is None:
            takes_part &= (state == GOING) & (steps < self.limits.steps)
            going = jnp.where(takes_part, state, float(FOUND))
        else:
            takes_part &= state < SUMMED_FOUND
            going = jnp.where(takes_part, float(GOING), float(FOUND)).astype(f.dtype)
        e = None if self.sums is None else as_varying(jnp.zeros((1, self.target.shape[0], slots), f.dtype), f)
        return MovingFeet(trial, best, f, steps, going, e), takes_part, state

    def _steps(self, part: Rows, feet: MovingFeet, bounds: Bounds, third: Array) -> MovingFeet:
        """The steps of a pass."""
        coefficients = row_coefficients(self.pieces, part)
        target = part.spread(self.target).reshape(1, -1, part.point.size)

        def step(carry: tuple[Array, MovingFeet]) -> tuple[Array, MovingFeet]:
            args = (target, coefficients, bounds, third, self.limits, self.creased, self.mode)
            return carry[0] + 1, advance(self.method, carry[1], *args)

        if part.point.shape[1] == 1:  # sorting anew costs less than moving feet that have ended
            return step((jnp.zeros((), jnp.int32), feet))[1]

        begun = jnp.sum(feet.state == GOING, dtype=jnp.int32)

        def goes_on(carry: tuple[Array, MovingFeet]) -> Array:
            going = jnp.sum(carry[1].state == GOING, dtype=jnp.int32)
            return (carry[0] < STEPS_PER_PASS) & (GOING_ONE_IN * going > begun)

        return lax.while_loop(goes_on, step, (jnp.zeros((), jnp.int32), feet))[1]

    def _sum(
        self, part: Rows, takes_part: Array, before: Array, feet: MovingFeet, bounds: Bounds, total: Any
    ) -> tuple[MovingFeet, Any]:
        """What those add that are done, and their state with that."""
        shape, mode = part.point.shape, self.mode
        assert self.sums is not None
        assert mode is not None
        given = None if self.weight is None else part.spread(self.weight[None]).reshape(1, 1, -1)

        def summands(
            feet: MovingFeet, given: Array | None, before: Array, takes_part: Array
        ) -> tuple[Array, ...]:
            found, done = feet.state == FOUND, takes_part & (feet.state == FOUND)
            if self.creased:  # a foot at a bound may have to go on
                done &= ~either((feet.best <= bounds.low) | (feet.best >= bounds.high))
            done |= takes_part & mode.single
            found &= ~mode.fixed | (before == FOUND)
            state = jnp.where(done, jnp.where(found, float(SUMMED_FOUND), float(SUMMED_GIVEN_UP)), feet.state)
            counts = done & jnp.isfinite(feet.f)
            one = np.ones((), feet.f.dtype)
            local = jnp.where(counts, lax.clamp(-one, bounds.local(feet.best), one), 0.0)
            assert feet.e is not None
            e, weight = jnp.where(counts, feet.e, 0.0), counts.astype(feet.f.dtype)
            return state, local, e, weight if given is None else weight * given

        always = self.limits.tolerance < jnp.inf
        state, local, e, weight = materialise(always, summands, feet, given, before, takes_part)
        s, t = local.reshape(2, *shape)
        return feet._replace(state=state), self.sums.add(
            total, part, s, t, e.reshape(-1, *shape), weight.reshape(shape)
        )
