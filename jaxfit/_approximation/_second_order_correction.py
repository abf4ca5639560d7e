r"""The right-hand side of the second-order correction of a step of `OrthogonalDistance`.

Under a move $M = B\,dP$ of the surface, with tangential coordinates $m = (J^T J)^{-1} J^T M$, feet slide by
$du = H^{-1} (M_\alpha \cdot e - J^T M)$, H and e as in `_distance_rows.py`. The normal part of the residual
$R(u^*(P)) - Q$ has the derivative $\Pi M$. Its second derivative, with the foot moving along, is

$$\Pi \big(M_\alpha (du^\alpha - m^\alpha) - R_{\alpha\beta}\, m^\alpha du^\beta\big).$$

Where a net slides along its surface this is the leading term, for then $\Pi M$ is nearly 0.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxfit._approximation._free_tangents import FreeTangents
from jaxfit._barrier import materialise
from jaxfit._cells import (
    Jet,
    Rows,
    cells_to_net,
    evaluate_first_order,
    evaluate_jet,
    local_coordinates,
    row_coefficients,
    row_moments,
    sum_over_blocks,
)
from jaxfit._closest import dot
from jaxfit._splines._pieces import Pieces

LEAST_SHARE = 0.5  # the share of the first form that must be left in the Hessian


def second_order_rhs(
    problem: Any,
    pieces: Pieces,
    moves: Pieces,
    rows: Rows,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    weight: Float[Array, " points"],
) -> Float[Array, "nu nv d"]:
    r"""$-\tfrac{1}{2} \sum_k w_k B_k^T \Pi_k r_k''$ for the move whose pieces are `moves`: the right side for
    the correction of that move, as the residuals are for the move itself. `rows` hold the points at their
    feet (u, v).
    """
    pieces, moves = jax.tree.map(jnp.asarray, (pieces, moves))
    (order_u, order_v), d = pieces.order, problem.target.shape[0]
    always = problem.diagonal > 0
    values = jnp.concatenate([problem.target, jnp.stack([u, v, weight])])

    def add(part: Rows, filled: Array, total: Array) -> Array:
        s, t, second = materialise(
            always, _second_derivative_at, pieces, moves, part, part.spread(values), filled
        )
        return total.at[part.cell].add(row_moments(s, t, second, order_u, order_v))

    begin = jnp.zeros((pieces.cells, order_u, order_v * d), u.dtype)
    total = sum_over_blocks(rows, add, begin)
    return cells_to_net(total, pieces.axis_u.polynomials, pieces.axis_v.polynomials)


def _second_derivative_at(
    pieces: Pieces, moves: Pieces, part: Rows, here: Array, filled: Array
) -> tuple[Array, Array, Array]:
    """Local coordinates, and -w / 2 times the second derivative of the normal part of the residual."""
    target, u, v, weight = here[:-3], here[-3], here[-2], jnp.where(filled, here[-1], 0.0)
    always = u[0, 0] >= pieces.axis_u.breaks[0]
    s, t = local_coordinates(pieces, part.cell[:, None], u, v)
    jet = materialise(always, evaluate_jet, row_coefficients(pieces, part), s, t)
    coefficients = row_coefficients(moves, part)
    value, value_s, value_t = materialise(always, evaluate_first_order, coefficients, s, t)
    e = target - jet.value
    free = FreeTangents.at(pieces, u, v, e, jet.s, jet.t)
    along = free.coordinates(value)
    right = (dot(e, value_s) - dot(jet.s, value), dot(e, value_t) - dot(jet.t, value))
    slide, valid = _slide(free, e, jet, along, right)
    (ms, mt), (ds, dt) = ([x[None] for x in pair] for pair in (along, slide))
    second = value_s * (ds - ms) + value_t * (dt - mt)
    second -= jet.ss * ms * ds + jet.st * (ms * dt + mt * ds) + jet.tt * mt * dt
    return s, t, jnp.where(valid[None], -0.5 * weight[None] * free.normal(second), 0.0)


def _slide(
    free: FreeTangents, e: Array, jet: Jet, along: tuple[Array, Array], right: tuple[Array, Array]
) -> tuple[tuple[Array, Array], Array]:
    """The moves of the feet, and whether these are valid: near the surface, by its radii of curvature.

    Where a foot is not free in both directions, its move is to first order in the distance.
    """
    E, F, G = dot(jet.s, jet.s), dot(jet.s, jet.t), dot(jet.t, jet.t)
    a, b, c = E - dot(e, jet.ss), F - dot(e, jet.st), G - dot(e, jet.tt)
    determinant = a * c - b * b
    valid = (a > LEAST_SHARE * E) & (determinant > LEAST_SHARE**2 * (E * G - F * F))
    both = valid & (free.per_first > 0) & (free.per_second > 0)
    inverse = 1.0 / jnp.where(both, determinant, 1.0)
    ds, dt = (c * right[0] - b * right[1]) * inverse, (a * right[1] - b * right[0]) * inverse
    return (jnp.where(both, ds, -along[0]), jnp.where(both, dt, -along[1])), valid
