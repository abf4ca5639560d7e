"""Restarted GMRES (Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986), preconditioned from the left."""

from collections.abc import Callable
from typing import Any, NamedTuple

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
    """The best net so far, and the one that the last cycle proposes."""

    best: Array
    image: Array
    left: Array
    proposed: Array
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
        image = apply(now.proposed)
        residual = precondition(right - image)
        size = jnp.linalg.norm(residual.reshape(-1))
        best, image, left = (
            jnp.where(size < now.left, new, old)
            for new, old in ((now.proposed, now.best), (image, now.image), (size, now.left))
        )
        first = jnp.where(now.cycles == 0, size, now.first)
        goal = rtol * first
        ended = (left <= goal) | (now.cycles == most_cycles) | ~(size < SLOW * now.left)
        proposed = lax.cond(
            ended, lambda: best, lambda: best + gmres_cycle(apply, precondition, residual, restart, goal)
        )
        return _Cycles(best, image, left, proposed, first, now.cycles + ~ended, ended)

    nothing, zero = jnp.zeros_like(right), jnp.zeros((), right.dtype)
    start = jnp.asarray(0, jnp.int32), jnp.asarray(False)
    begin = _Cycles(nothing, nothing, zero + jnp.inf, nothing, zero, *start)
    end = lax.while_loop(lambda now: ~now.ended, cycle, begin)
    left = end.left / jnp.where(end.first > 0, end.first, 1.0)
    return GmresSolution(end.best, end.image, left, end.cycles)


def gmres_cycle(
    apply: Operator, precondition: Operator, residual: Array, restart: int, goal: Any = 0.0
) -> Array:
    """One cycle from zero: the x of the Krylov space for which |residual - M A x| is smallest, or `goal`; the
    residual is a preconditioned one.

    Twice classical Gram-Schmidt. An exhausted space adds zero vectors, which the least-squares problem leaves
    alone. Rotations of its rows say how much of the residual is left.
    """
    first = residual.reshape(-1)
    size = jnp.linalg.norm(first)
    info = jnp.finfo(first.dtype)
    basis = (
        jnp.zeros((restart + 1, first.shape[0]), first.dtype).at[0].set(first / jnp.maximum(size, info.tiny))
    )
    projected = jnp.zeros((restart + 1, restart), first.dtype)

    def extend(state: Any) -> Any:
        k, basis, projected, rotations, _ = state
        new = precondition(apply(basis[k].reshape(residual.shape))).reshape(-1)
        scale = jnp.linalg.norm(new)
        once = basis @ new
        new = new - once @ basis
        twice = basis @ new
        new = new - twice @ basis
        length = jnp.linalg.norm(new)
        fresh = length > 10 * info.eps * scale
        length = jnp.where(fresh, length, 0.0)
        basis = basis.at[k + 1].set(jnp.where(fresh, new / jnp.where(fresh, length, 1.0), 0.0))
        column = (once + twice).at[k + 1].set(length)
        turned = rotations @ column
        radius = jnp.sqrt(turned[k] ** 2 + turned[k + 1] ** 2)
        radius = jnp.where(radius > 0, radius, 1.0)
        c, s, upper, lower = turned[k] / radius, turned[k + 1] / radius, rotations[k], rotations[k + 1]
        rotations = rotations.at[k].set(c * upper + s * lower).at[k + 1].set(c * lower - s * upper)
        left = size * jnp.abs(rotations[k + 1, 0])
        return k + 1, basis, projected.at[:, k].set(column), rotations, left

    def unfinished(state: Any) -> Array:
        return (state[0] < restart) & (state[4] > goal)

    begin = (jnp.asarray(0, jnp.int32), basis, projected, jnp.eye(restart + 1, dtype=first.dtype), size)
    _, basis, projected, _, _ = lax.while_loop(unfinished, extend, begin)
    target = jnp.zeros(restart + 1, first.dtype).at[0].set(size)
    weights = jnp.linalg.lstsq(projected, target)[0]
    return (weights @ basis[:-1]).reshape(residual.shape)
