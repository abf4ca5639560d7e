"""Restarted GMRES (Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986), preconditioned from the left."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

Operator = Callable[[Array], Array]

SLOW = 0.9  # a cycle that leaves more of the residual than this is the last


class GmresSolution(NamedTuple):
    """An approximate solution, the share of the residual that is `left`, and the cycles it took."""

    net: Float[Array, "n m d"]
    left: Float[Array, ""]
    cycles: Int[Array, ""]


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

    def size(x: Array) -> Array:
        return jnp.sqrt(jnp.sum(precondition(x) ** 2))

    State = tuple[Array, Array, Array, Array, Array]

    def unfinished(state: State) -> Array:
        _, _, left, cycles, slow = state
        return ~slow & (left > goal) & (cycles < most_cycles)

    def cycle(state: State) -> State:
        x, residual, before, cycles, _ = state
        moved = x + gmres_cycle(apply, precondition, residual, restart, goal)
        rest = right - apply(moved)
        after = size(rest)
        better = after < before
        x, residual = (jnp.where(better, new, old) for new, old in ((moved, x), (rest, residual)))
        return x, residual, jnp.where(better, after, before), cycles + 1, ~(after < SLOW * before)

    first = size(right)
    goal = rtol * first
    begin = (jnp.zeros_like(right), right, first, jnp.asarray(0, jnp.int32), jnp.asarray(False))
    x, _, left, cycles, _ = lax.while_loop(unfinished, cycle, begin)
    return GmresSolution(x, left / jnp.where(first > 0, first, 1.0), cycles)


def gmres_cycle(
    apply: Operator, precondition: Operator, right: Array, restart: int, goal: Any = 0.0
) -> Array:
    """One cycle from zero: the x of the Krylov space for which M (right - A x) is smallest, or `goal`.

    Twice classical Gram-Schmidt. An exhausted space adds zero vectors, which the least-squares problem leaves
    alone. Rotations of its rows say how much of the residual is left.
    """
    first = precondition(right).reshape(-1)
    size = jnp.linalg.norm(first)
    info = jnp.finfo(right.dtype)
    basis = (
        jnp.zeros((restart + 1, first.shape[0]), right.dtype).at[0].set(first / jnp.maximum(size, info.tiny))
    )
    projected = jnp.zeros((restart + 1, restart), right.dtype)

    def extend(state: Any) -> Any:
        k, basis, projected, rotations, _ = state
        new = precondition(apply(basis[k].reshape(right.shape))).reshape(-1)
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

    begin = (jnp.asarray(0, jnp.int32), basis, projected, jnp.eye(restart + 1, dtype=right.dtype), size)
    _, basis, projected, _, _ = lax.while_loop(unfinished, extend, begin)
    target = jnp.zeros(restart + 1, right.dtype).at[0].set(size)
    weights = jnp.linalg.lstsq(projected, target)[0]
    return (weights @ basis[:-1]).reshape(right.shape)
