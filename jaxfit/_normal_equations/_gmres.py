"""Restarted GMRES (Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986), preconditioned from the left."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

Operator = Callable[[Array], Array]

SLOW = 0.9  # a cycle that leaves more of the residual than this is the last


class GmresSolution(NamedTuple):
    """An approximate solution and its `image` under the matrix, the share of the residual that is `left`, and
    the cycles it took.
    """

    net: Float[Array, "n m d"]
    image: Float[Array, "n m d"]
    left: Float[Array, ""]
    cycles: Int[Array, ""]


class _Cycles(NamedTuple):
    """The best net so far, and the one that the last cycle proposes, each with its image."""

    best: tuple[Array, Array]
    left: Array
    proposed: tuple[Array, Array]
    first: Array  # the size of the right-hand side
    cycles: Array
    ended: Array


def gmres(
    apply: Operator,
    precondition: Operator,
    right: Float[Array, "n m d"],
    restart: int,
    rtol: Any,
    most_cycles: int,
) -> GmresSolution:
    """Solves a regular system, symmetric or not, from 0.

    Stops where the preconditioned residual is `rtol` times the preconditioned right-hand side, or where a
    cycle takes less than a tenth of it away. A cycle that makes it greater is not accepted.
    """

    def cycle(now: _Cycles) -> _Cycles:
        residual = precondition(right - now.proposed[1])
        size = jnp.linalg.norm(residual.reshape(-1))
        best, left = jax.tree.map(
            partial(jnp.where, size < now.left), (now.proposed, size), (now.best, now.left)
        )
        first = jnp.where(now.cycles == 0, size, now.first)
        goal = rtol * first
        ended = (left <= goal) | (now.cycles == most_cycles) | ~(size < SLOW * now.left)

        def propose() -> tuple[Array, Array]:
            move = gmres_cycle(apply, precondition, residual, restart, goal)
            return best[0] + move[0], best[1] + move[1]

        proposed = lax.cond(ended, lambda: best, propose)
        return _Cycles(best, left, proposed, first, now.cycles + ~ended, ended)

    nothing, zero = (jnp.zeros_like(right),) * 2, jnp.zeros((), right.dtype)
    start = jnp.asarray(0, jnp.int32), jnp.asarray(False)
    begin = _Cycles(nothing, zero + jnp.inf, nothing, zero, *start)
    end = lax.while_loop(lambda now: ~now.ended, cycle, begin)
    left = end.left / jnp.where(end.first > 0, end.first, 1.0)
    return GmresSolution(*end.best, left, end.cycles)


def gmres_cycle(
    apply: Operator, precondition: Operator, residual: Array, restart: int, goal: Any = 0.0
) -> tuple[Array, Array]:
    """One cycle from zero: the x of the Krylov space for which |residual - M A x| is smallest, or `goal`, and
    A x; the residual is a preconditioned one.

    Twice classical Gram-Schmidt. Rotations of the rows say how much of the residual is left. The cycle ends
    where the space is exhausted. A x is summed from the images of the space, so that the matrix is applied
    in one place of the program only.
    """
    first = residual.reshape(-1)
    size = jnp.linalg.norm(first)
    info = jnp.finfo(first.dtype)
    space = jnp.zeros((restart + 1, first.shape[0]), first.dtype)
    basis, images = space.at[0].set(first / jnp.maximum(size, info.tiny)), space[:-1]
    projected = jnp.zeros((restart + 1, restart), first.dtype)

    def extend(state: Any) -> Any:
        k, basis, images, projected, rotations, _ = state
        image = apply(basis[k].reshape(residual.shape))
        new = precondition(image).reshape(-1)
        scale = jnp.linalg.norm(new)
        once = basis @ new
        new = new - once @ basis
        twice = basis @ new
        new = new - twice @ basis
        length = jnp.linalg.norm(new)
        fresh = length > 10 * info.eps * scale
        length = jnp.where(fresh, length, 0.0)
        basis = basis.at[k + 1].set(jnp.where(fresh, new / jnp.where(fresh, length, 1.0), 0.0))
        images = images.at[k].set(image.reshape(-1))
        column = (once + twice).at[k + 1].set(length)
        turned = rotations @ column
        radius = jnp.sqrt(turned[k] ** 2 + turned[k + 1] ** 2)
        radius = jnp.where(radius > 0, radius, 1.0)
        c, s, upper, lower = turned[k] / radius, turned[k + 1] / radius, rotations[k], rotations[k + 1]
        rotations = rotations.at[k].set(c * upper + s * lower).at[k + 1].set(c * lower - s * upper)
        left = size * jnp.abs(rotations[k + 1, 0])
        return k + 1, basis, images, projected.at[:, k].set(column), rotations, left

    def unfinished(state: Any) -> Array:
        return (state[0] < restart) & (state[5] > goal)

    begin = jnp.asarray(0, jnp.int32), basis, images, projected, jnp.eye(restart + 1, dtype=first.dtype), size
    _, basis, images, projected, rotations, _ = lax.while_loop(unfinished, extend, begin)
    weights = _linear_least_squares(rotations, projected, size)
    return (weights @ basis[:-1]).reshape(residual.shape), (weights @ images).reshape(residual.shape)


def _linear_least_squares(rotations: Array, projected: Array, size: Array) -> Float[Array, " restart"]:
    """The weights for which |size e_1 - projected weights| is smallest; the rotations make `projected`
    triangular. What adds nothing to the space has weight 0.
    """
    triangle, right = (rotations @ projected)[:-1], size * rotations[:-1, 0]
    diagonal = jnp.abs(jnp.diagonal(triangle))
    used = diagonal > jnp.finfo(diagonal.dtype).eps * jnp.max(diagonal)
    triangle = jnp.where(used[:, None], triangle, jnp.eye(len(used), dtype=diagonal.dtype))
    right = jnp.where(used, right, 0.0)
    return lax.linalg.triangular_solve(triangle, right[:, None], left_side=True)[:, 0]
