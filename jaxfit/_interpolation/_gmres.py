"""GMRES until the largest error of a grid is small enough, with the errors of every cycle recorded."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._fit._history import ErrorHistory
from jaxfit._normal_equations import Operator, gmres_cycle

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
        move, image = gmres_cycle(apply, precondition, precondition(residual), restart)
        moved, rest = x + move, residual - image
        before, after = history.at(step)[1], jnp.max(distances(rest, limits.diagonal))
        better = after < before
        x, residual = (jnp.where(better, new, old) for new, old in ((moved, x), (rest, residual)))
        history = append_errors(history, step + 1, distances(residual, limits.diagonal))
        return x, residual, step + 1, history, ~(after < SLOW * before)

    begin = (x, right - apply(x), step, history, jnp.asarray(False))
    x, _, step, history, _ = lax.while_loop(goes_on, cycle, begin)
    return x, step, history
