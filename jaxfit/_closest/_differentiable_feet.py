r"""Feet that have been found as functions of surface and points, and the sums over the points there.

In both modes of differentiation: a move of a foot is a number that is zero and has the derivative of a
closest point.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._cells import Rows, cells_of, evaluate_jet, local_coordinates, take
from jaxfit._closest._forms import dot
from jaxfit._closest._implicit import foot_moves
from jaxfit._splines._pieces import Pieces
from jaxfit._unrolling import root


def follow_feet(
    pieces: Pieces,
    target: Float[Array, "d points"],
    feet: tuple[Array, Array],
    before: tuple[Array, Array],
    idle: Bool[Array, " points"],
    sums: Any,
    weight: Float[Array, " points"] | None,
) -> tuple[Array, Array, Array, Any]:
    """u, v, the errors, and the `sums` of `update_feet`; idle points stay as they were `before`."""
    pieces = jax.tree.map(jnp.asarray, pieces)
    u, v = lax.stop_gradient(feet)
    cell = cells_of(pieces, u, v)
    s, t = (x[:, None] for x in lax.stop_gradient(local_coordinates(pieces, cell, u, v)))
    jet = evaluate_jet(take(pieces.coefficients, cell, 0), s, t)
    goal = target[:, :, None]
    extent = jnp.max(jnp.abs(target))
    ds, dt = foot_moves(pieces, (u[:, None], v[:, None]), goal, jet, extent)
    e = goal - jet.value - lax.stop_gradient(jet.s) * ds[None] - lax.stop_gradient(jet.t) * dt[None]
    half_u, half_v = pieces.axis_u.half, pieces.axis_v.half
    cells_v = pieces.axis_v.cells
    u = jnp.where(idle, before[0], u + half_u[cell // cells_v] * ds[:, 0])
    v = jnp.where(idle, before[1], v + half_v[cell % cells_v] * dt[:, 0])
    error = jnp.where(idle, 0.0, root(dot(e, e))[:, 0])
    total = ()
    if sums is not None:
        count = cell.shape[0]
        rows = Rows(cell, jnp.arange(count)[:, None], jnp.asarray(count, jnp.int32), count)
        given = jnp.ones_like(u) if weight is None else weight
        given = jnp.where(idle, 0.0, given)[:, None]
        total = sums.finish(sums.add(sums.begin(pieces), rows, s + ds, t + dt, e, given), pieces)
    return u, v, error, total
