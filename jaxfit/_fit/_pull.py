"""How error vectors pull on control points: the sums of Algorithm 1, in one pass over the points.

Points lie in rows of one cell, and a block of rows at a time is evaluated, moved and summed, so that what
it needs stays in a core's caches.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._cells import (
    Rows,
    cells_to_net,
    evaluate_jet,
    evaluate_values,
    local_coordinates,
    over_blocks,
    row_coefficients,
    row_moments,
    row_width,
    rows_of,
    staged,
)
from jaxfit._closest import AbstractFootMethod, box_of, follow
from jaxfit._splines._pieces import Pieces


class Pulls(eqx.Module):
    """What a pass over the points gives: sum_k w_k N_i N_j e_k and, last, sum_k w_k N_i N_j."""

    sums: Float[Any, "nu nv c"]

    @property
    def means(self) -> Float[Array, "nu nv d"]:
        """Weighted means of the error vectors around each control point, 0 where no point pulls."""
        total = self.sums[..., -1:]
        touched = total > 0
        return jnp.where(touched, self.sums[..., :-1] / jnp.where(touched, total, 1.0), 0.0)


class _Pass(eqx.Module):
    feet: Float[Array, "3 points"]  # u, v and the length of the residual
    cells: Float[Array, "cells K Lc"]
    active: Int[Array, ""]


def pull(
    problem: Any,
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    error: Float[Array, " points"],
    idle: Bool[Array, " points"],
    weigh: Callable[[Array, Array], Array],
    method: AbstractFootMethod | None,
) -> tuple[Float[Array, "3 points"], Pulls, Int[Array, ""]]:
    """The feet with the lengths of their residuals, the sums there, and how many points pull.

    `idle` points have no part in it, and keep the `error` they have. `weigh(weight, error)` says how much
    points pull; with a `method` each foot first takes one of its steps, and its residual is the one foreseen.
    """
    pieces = jax.tree.map(jnp.asarray, pieces)
    rows = rows_of(pieces, u, v, row_width(u.shape[0], pieces.cells), idle)
    (order_u, order_v), d = pieces.order, problem.target.shape[0]

    def add(part: Rows, filled: Array, done: _Pass) -> _Pass:
        here = part.spread(jnp.concatenate([problem.target, jnp.stack([u, v, problem.weight])]))
        next_u, next_v, e = _step(problem, pieces, part, here, method)
        always = problem.diagonal > 0
        error = staged(always, lambda e: jnp.sqrt(sum(x * x for x in e)), e)

        def summands(u: Array, v: Array, e: Array, error: Array) -> tuple[Array, Array, Array]:
            s, t = local_coordinates(pieces, part.cell[:, None], u, v)
            weight = jnp.where(filled, weigh(here[-1], error), 0.0)
            # A foot that leaves its cell pulls from the cell's edge this once.
            values = jnp.concatenate([weight[None] * e, weight[None]])
            return jnp.clip(s, -1.0, 1.0), jnp.clip(t, -1.0, 1.0), values

        s, t, values = staged(always, summands, next_u, next_v, e, error)
        moments = row_moments(s, t, values, order_u, order_v)
        feet = done.feet.at[:, part.point].set(jnp.stack([next_u, next_v, error]), mode="drop")
        active = done.active + jnp.sum(values[-1] > 0, dtype=jnp.int32)
        return _Pass(feet, done.cells.at[part.cell].add(moments), active)

    begin = _Pass(
        jnp.stack([u, v, error]),
        jnp.zeros((pieces.cells, order_u, order_v * (d + 1)), u.dtype),
        jnp.asarray(0, jnp.int32),
    )
    done = over_blocks(rows, add, begin)
    sums = cells_to_net(done.cells, pieces.axis_u.polynomials, pieces.axis_v.polynomials)
    return done.feet, Pulls(sums), done.active


def _step(
    problem: Any, pieces: Pieces, part: Rows, here: Array, method: AbstractFootMethod | None
) -> tuple[Array, Array, Array]:
    """Feet and residuals after a step, or as they are."""
    always = problem.diagonal > 0
    target, u, v = here[:-3], here[-3], here[-2]
    s, t = local_coordinates(pieces, part.cell[:, None], u, v)
    coefficients = row_coefficients(pieces, part)
    if method is None:
        e = staged(always, lambda *x: target - evaluate_values(*x), coefficients, s, t)
        return u, v, e
    jet = staged(always, evaluate_jet, coefficients, s, t)
    axes = (pieces.axis_u, pieces.axis_v)
    box = box_of(pieces, part.cell, [x for a in axes for x in (a.breaks[0], a.breaks[-1])])
    tolerance = problem.foot_tolerance * problem.diagonal

    return follow(method, target - jet.value, jet, u, v, box, tolerance)
