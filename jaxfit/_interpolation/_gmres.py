"""Restarted GMRES (Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986), preconditioned from the left."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._fit._history import ErrorHistory

Operator = Callable[[Array], Array]

SLOW = 0.9  # a cycle that leaves more of the largest error than this is the last


class GmresLimits(eqx.Module):
    """When to stop: errors are lengths over `diagonal`, cycles are counted in the history."""

    diagonal: Array
    tolerance: Array
    max_steps: Array


def distances(residual: Float[Array, "n m d"], diagonal: Array) -> Float[Array, "n m"]:
    """Lengths of the residuals as fractions of the diagonal."""
    return jnp.sqrt(jnp.sum(residual**2, axis=-1)) / diagonal


def append_errors(history: ErrorHistory, step: Array, errors: Float[Array, "n m"]) -> ErrorHistory:
    """With the errors after `step` cycles, for which no feet are found."""
    return history.append(step, (jnp.mean(errors), jnp.max(errors), 0.0, 0.0))


def gmres_solve(
    apply: Operator,
    precondition: Operator,
    right: Float[Array, "n m d"],
    x: Float[Array, "n m d"],
    step: Array,
    history: ErrorHistory,
    limits: GmresLimits,
    restart: int,
) -> tuple[Array, Array, ErrorHistory]:
    """Cycles from `x`, whose errors are those of `step` in `history`, until the largest error is within the
    tolerance, or a cycle takes less than a tenth of it away, or all are done. The last step is returned, too.

    A cycle that makes the largest error greater is not accepted.
    """
    State = tuple[Array, Array, Array, ErrorHistory, Array]

    def goes_on(state: State) -> Array:
        _, _, step, history, slow = state
        return ~slow & (history.at(step)[1] > limits.tolerance) & (step < limits.max_steps)

    def cycle(state: State) -> State:
        x, residual, step, history, _ = state
        moved = x + gmres_cycle(apply, precondition, residual, restart)
        rest = right - apply(moved)
        before, after = history.at(step)[1], jnp.max(distances(rest, limits.diagonal))
        better = after < before
        x, residual = (jnp.where(better, new, old) for new, old in ((moved, x), (rest, residual)))
        history = append_errors(history, step + 1, distances(residual, limits.diagonal))
        return x, residual, step + 1, history, ~(after < SLOW * before)

    begin = (x, right - apply(x), step, history, jnp.asarray(False))
    x, _, step, history, _ = lax.while_loop(goes_on, cycle, begin)
    return x, step, history


def gmres_cycle(apply: Operator, precondition: Operator, right: Array, restart: int) -> Array:
    """One cycle from zero: the x of the Krylov space for which M (right - A x) is smallest.

    Twice classical Gram-Schmidt. An exhausted space adds zero vectors, which the least-squares problem leaves
    alone.
    """
    first = precondition(right).reshape(-1)
    size = jnp.linalg.norm(first)
    info = jnp.finfo(right.dtype)
    basis = (
        jnp.zeros((restart + 1, first.shape[0]), right.dtype).at[0].set(first / jnp.maximum(size, info.tiny))
    )
    projected = jnp.zeros((restart + 1, restart), right.dtype)

    def extend(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        basis, projected = state
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
        return basis, projected.at[:, k].set((once + twice).at[k + 1].set(length))

    basis, projected = lax.fori_loop(0, restart, extend, (basis, projected))
    goal = jnp.zeros(restart + 1, right.dtype).at[0].set(size)
    weights = jnp.linalg.lstsq(projected, goal)[0]
    return (weights @ basis[:-1]).reshape(right.shape)
