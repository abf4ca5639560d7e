r"""One Gauss-Newton step on the true distances: rows, normal equations and gradient, in one pass.

With the foot $u^*(P)$ of a point eliminated, the residual $r = R(u^*(P)) - Q$ has the derivative

$$dr = (I - J H^{-1} J^T)\, B\, dP + J H^{-1} (B_u dP \cdot e,\; B_v dP \cdot e), \qquad e = -r,$$

where $B\,dP$ is the change of the surface at fixed parameters, J the tangents $[R_u, R_v]$ and
$H = J^T J - e \cdot R_{(uu, uv, vv)}$ the Hessian of half the squared distance. With the projection $\Pi$
on the normal space, $\Pi J = 0$ and so $\Pi\, dr = \Pi\, B\, dP$ exactly, curved or not; and r lies in the
normal space. What is left, in the tangent space, is of the size of curvature times distance, and does not
change the length of r to first order: $d|r| = (r / |r|) \cdot B\, dP$. So the rows are $\Pi B$, for a
surface in space $n^T B$. At a foot on the border only directions in which it is free to move are in J.

$\Pi + \mu (I - \Pi)$ in place of $\Pi$ blends these rows with those at fixed parameters, where mu is 1.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._approximation._free_tangents import FreeTangents
from jaxfit._barrier import materialise
from jaxfit._cells import (
    Rows,
    cells_to_net,
    evaluate_first_order,
    local_coordinates,
    row_coefficients,
    row_moments,
    row_width,
    rows_of,
    sum_over_blocks,
)
from jaxfit._normal_equations import CoupledStencil, coupled_stencil
from jaxfit._splines._pieces import Pieces
from jaxfit._unrolling import without_influence


class NormalEquations(eqx.Module):
    """A^T A and A^T e of the rows A = (Pi + mu (I - Pi))^(1/2) B, weighted."""

    matrix: CoupledStencil
    gradient: Float[Array, "nu nv d"]


class _Sums(eqx.Module):
    squares: Float[Array, "cells A Bp"]
    right: Float[Array, "cells K Lc"]


def rows_with_influence(
    pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"], weight: Float[Array, " points"]
) -> Rows:
    """Points with feet (u, v) in rows; points of weight 0 take no part."""
    pieces = jax.tree.map(jnp.asarray, pieces)
    return rows_of(pieces, u, v, row_width(u.shape[0], pieces.cells), without_influence(weight))


def normal_equations(
    problem: Any,
    pieces: Pieces,
    rows: Rows,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    weight: Float[Array, " points"],
    damping: Float[Array, ""],
) -> NormalEquations:
    """The normal equations at feet (u, v), for `damping` mu; `rows` are those of `rows_with_influence`."""
    pieces = jax.tree.map(jnp.asarray, pieces)
    (order_u, order_v), d = pieces.order, problem.target.shape[0]
    pairs = d * (d + 1) // 2
    always = problem.diagonal > 0
    values = jnp.concatenate([problem.target, jnp.stack([u, v, weight])])

    def add(part: Rows, filled: Array, done: _Sums) -> _Sums:
        s, t, e, entries = materialise(always, _rows_at, pieces, part, part.spread(values), filled, damping)
        squares = row_moments(s, t, entries, 2 * order_u - 1, 2 * order_v - 1)
        right = row_moments(s, t, e, order_u, order_v)
        return _Sums(done.squares.at[part.cell].add(squares), done.right.at[part.cell].add(right))

    begin = _Sums(
        jnp.zeros((pieces.cells, 2 * order_u - 1, (2 * order_v - 1) * pairs), u.dtype),
        jnp.zeros((pieces.cells, order_u, order_v * d), u.dtype),
    )
    done = sum_over_blocks(rows, add, begin)
    matrix = coupled_stencil(done.squares, pieces.axis_u, pieces.axis_v, d)
    gradient = cells_to_net(done.right, pieces.axis_u.polynomials, pieces.axis_v.polynomials)
    return NormalEquations(matrix, gradient)


def _rows_at(
    pieces: Pieces, part: Rows, here: Array, filled: Array, damping: Array
) -> tuple[Array, Array, Array, Array]:
    """Local coordinates, weighted residuals, and the entries of w (Pi + mu (I - Pi))."""
    target, u, v, weight = here[:-3], here[-3], here[-2], jnp.where(filled, here[-1], 0.0)
    s, t = local_coordinates(pieces, part.cell[:, None], u, v)
    coefficients = row_coefficients(pieces, part)
    always = u[0, 0] >= pieces.axis_u.breaks[0]
    value, *tangents = materialise(always, evaluate_first_order, coefficients, s, t)
    e = target - value
    tangential = FreeTangents.at(pieces, u, v, e, *tangents).entries()
    d = target.shape[0]
    same = jnp.asarray(np.equal(*np.triu_indices(d)), s.dtype)[:, None, None]
    return s, t, weight[None] * e, weight[None] * (same - (1.0 - damping) * tangential)
