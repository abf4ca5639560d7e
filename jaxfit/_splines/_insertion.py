"""Knot insertion: many knots at once, exactly, by the blossom (Oslo algorithm)."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxfit._compile import compiled
from jaxfit._splines._basis import as_parameters, blossom_weights, find_span, local_knots
from jaxfit._splines._lookup import windows


def refined_knots(knots: Float[Array, " knots"], new_knots: ArrayLike) -> Float[Array, " refined"]:
    """The sorted union of the knots and the new ones, repeats kept."""
    return jnp.sort(jnp.concatenate([knots, as_parameters(new_knots, knots).astype(knots.dtype)]))


def insertion_weights(
    knots: Float[Array, " knots"], refined: Float[Array, " refined"], order: int
) -> tuple[Int[Array, " n"], Float[Array, "order n"]]:
    r"""Each refined control point as a sum of `order` consecutive old ones.

    The refined point $j$ is the blossom of the old polynomial piece at the refined knots
    $\hat t_{j+1}, \dots, \hat t_{j+K-1}$ (Oslo algorithm; NURBS Book, section 5.3, inserts the
    same knots one sweep at a time). The piece is the one at $\hat t_j$.

    Returns
    -------
    first : array (n_refined,)
        Index of the first old control point of each sum.
    weights : array (order, n_refined)
        Non-negative, of sum one.
    """
    count = refined.shape[0] - order
    span = find_span(knots, order, refined[:count])
    arguments = windows(refined, np.arange(1, count + 1), order - 1)
    weights = blossom_weights(local_knots(knots, order, span), arguments)
    return span - (order - 1), weights


@partial(compiled, static_argnames="order")
def insertion_matrix(
    knots: Float[Array, " knots"], order: int, new_knots: ArrayLike
) -> Float[Array, "refined n"]:
    r"""Matrix that takes control points to those on the refined knot vector (Oslo algorithm).

    Parameters
    ----------
    knots : array (n + order,)
    order : int
        Degree + 1.
    new_knots : array (m,)
        Inside the domain, in any order, repeats allowed as long as no interior knot ends up
        more often than `order` times. May be traced; only their number shapes the result.

    Returns
    -------
    array (n + m, n)
        Row $j$ holds at most `order` entries, non-negative and of sum one. The spline is the
        same function to rounding.

    Notes
    -----
    Source: E. Cohen, T. Lyche and R. Riesenfeld, Computer Graphics and Image Processing 14 (1980).

    Examples
    --------
    A knot in the middle of a parabola without interior knots cuts both legs of its control polygon:

    >>> print(jf.insertion_matrix(jf.clamped_uniform_knots(3, 3), 3, np.array([0.5])))
    [[1.  0.  0. ]
     [0.5 0.5 0. ]
     [0.  0.5 0.5]
     [0.  0.  1. ]]
    """
    refined = refined_knots(knots, new_knots)
    first, weights = insertion_weights(knots, refined, order)
    columns = first[:, None] + jnp.arange(order)[None, :]
    rows = jnp.arange(first.shape[0])[:, None]
    matrix = jnp.zeros((first.shape[0], knots.shape[0] - order), knots.dtype)
    return matrix.at[rows, columns].set(weights.T)


@compiled
def insert_along(
    control_points: Float[Array, "n ..."], knots: Float[Array, " knots"], new_knots: ArrayLike
) -> tuple[Float[Array, "refined ..."], Float[Array, " refined_knots"]]:
    """Control points and knots after insertion along the first axis."""
    order = knots.shape[0] - control_points.shape[0]
    refined = refined_knots(knots, new_knots)
    first, weights = insertion_weights(knots, refined, order)
    near = windows(control_points, first, order)
    moved = jnp.einsum("ri...,ri->i...", near, weights, precision=lax.Precision.HIGHEST)
    return moved, refined


@compiled
def insert_in_net(
    control_points: Float[Array, "nu nv d"],
    knots_u: Float[Array, " knots_u"],
    knots_v: Float[Array, " knots_v"],
    new_u: Float[Array, " m"],
    new_v: Float[Array, " n"],
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Control points and both knot vectors after insertion along both directions."""
    net, refined_u = insert_along(control_points, knots_u, new_u)
    net, refined_v = insert_along(jnp.swapaxes(net, 0, 1), knots_v, new_v)
    return jnp.swapaxes(net, 0, 1), refined_u, refined_v
