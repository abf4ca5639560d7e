"""One step of `OrthogonalDistance`: a damped Gauss-Newton step and its second-order correction."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._approximation._damping import USUAL_DAMPING, within_reach
from jaxfit._approximation._distance_rows import NormalEquations
from jaxfit._normal_equations import (
    AbstractPenalty,
    coupled_preconditioner,
    free_points,
    solve_coupled,
)
from jaxfit._unrolling import constant, root

# Conjugate gradients stop at this relative residual, which takes a step or two on small nets, where they have
# the factors of the matrix. Or after so many steps: few where nets are large, for far from the end an exact
# solution is no better. At small mu steps achieve what they predict, and the last digits take many.
RESIDUAL = 1e-9
SMALL_NET = 1000  # control points
FEW_STEPS, SOME_STEPS, MANY_STEPS = 16, 32, 100
LARGEST_CORRECTION = 0.75  # of second order, as a share of the step


def gauss_newton_step(
    penalty: AbstractPenalty,
    correction_rhs: Callable[[Array], Array],
    equations: NormalEquations,
    net: Float[Array, "nu nv d"],
    held: Bool[Array, "nu nv"],
    longest: Float[Array, "nu nv"],
    damping: Float[Array, ""],
    second_order: Bool[Array, ""],
) -> tuple[Float[Array, "nu nv d"], Float[Array, ""]]:
    """The net after the step, and the predicted reduction of the objective.

    `correction_rhs(move)` is the right-hand side of the system that gives the correction of a move; only
    steps of `second_order` have one. At damping 1 moves may be longer than `longest`.
    """
    stiffness, bent = penalty.system(net)
    matrix = equations.matrix.plus(stiffness)
    data = equations.matrix.at_fixed_parameters(damping)
    free = free_points(data.plus(stiffness), held)
    right = equations.gradient - bent
    right = jnp.where(free[:, :, None], right, 0.0)
    # Data weighs 1 across the surface and mu along it, smoothing the same in all directions; factors for the
    # geometric mean serve both.
    between = data.times(jnp.sqrt(damping)).plus(stiffness)
    preconditioner = coupled_preconditioner(constant(matrix), constant(between), free)
    damped = damping < 1
    residual = max(RESIDUAL, 10.0 * float(jnp.finfo(right.dtype).eps))
    usual = FEW_STEPS if net.shape[0] * net.shape[1] > SMALL_NET else SOME_STEPS
    most = jnp.where(damping < USUAL_DAMPING, MANY_STEPS, usual)

    def solve(move: Array, is_step: Array) -> tuple[Array, Array]:
        """The move, and then its correction, whose right-hand side depends on the move."""
        rhs = lax.cond(
            is_step,
            lambda: right,
            lambda: lax.cond(second_order, lambda: correction_rhs(move), lambda: jnp.zeros_like(net)),
        )
        solution = solve_coupled(matrix, rhs, free, preconditioner, residual, most).net
        limited = jnp.where(damped, within_reach(solution, longest), solution)
        return jnp.where(is_step, limited, move), solution

    move, (_, correction) = lax.scan(solve, jnp.zeros_like(net), jnp.asarray([True, False]))
    predicted = jnp.sum(move * (2.0 * right - matrix(move)))
    whole = within_reach(move + _at_most(LARGEST_CORRECTION, correction, move), longest)
    return net + jnp.where(damped, whole, move), predicted


def _at_most(share: float, correction: Array, move: Array) -> Array:
    """The correction, no longer than a share of the move."""
    length, most = root(jnp.sum(correction**2)), share * root(jnp.sum(move**2))
    return jnp.where(length > most, most / jnp.where(length > 0, length, 1.0), 1.0) * correction
