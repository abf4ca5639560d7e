"""Linear systems with the derivative of G: matrix-free GMRES, preconditioned by the Gauss-Newton matrix."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._approximation._distance_rows import normal_equations
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import Operator, Stencil, coupled_preconditioner, free_points, gmres

RESTART, MOST_CYCLES = 40, 25  # of GMRES
# The share of the rows at fixed parameters in the preconditioner: what curvature adds along the surface.
DAMPING = 1e-3


class NewtonPreconditioner(eqx.Module):
    """Near the inverse of the derivative of G, and the control points that G determines."""

    factors: Any
    free: Bool[Array, "nu nv"]

    def __call__(self, x: Float[Array, "nu nv d"]) -> Float[Array, "nu nv d"]:
        """Near the solution."""
        return self.factors(x)


def newton_preconditioner(
    method: AbstractIterativeMethod,
    state: Any,
    surface: WorkingSurface,
    problem: Problem,
    feet: tuple[Array, Array],
    error: Float[Array, " points"],
) -> NewtonPreconditioner:
    """The factored Gauss-Newton matrix. It is symmetric, so it serves the transposed system, too."""
    condition = method.stationarity(problem, surface, state, error)
    damping = jnp.asarray(DAMPING if method.finds_feet else 1.0, error.dtype)
    matrix = normal_equations(problem, surface.pieces, *feet, condition.weight, damping).matrix
    uncoupled = Stencil(matrix.trace.entries / (1.0 + (problem.target.shape[0] - 1) * damping))
    if condition.penalty is not None:
        stiffness = condition.penalty.system(surface.control_points)[0]
        matrix, uncoupled = matrix.plus(stiffness, 1.0), uncoupled.plus(stiffness, 1.0)
    free = free_points(uncoupled, condition.held)
    return NewtonPreconditioner(coupled_preconditioner(matrix, uncoupled, free), free)


def solve_newton(
    apply: Operator, preconditioner: NewtonPreconditioner, right: Float[Array, "nu nv d"], rtol: float
) -> Float[Array, "nu nv d"]:
    """x with A x = right, for A or its transpose."""
    return gmres(apply, preconditioner, right, RESTART, rtol, MOST_CYCLES).net


def solve_differentiably(
    apply: Operator, preconditioner: NewtonPreconditioner, right: Float[Array, "nu nv d"], rtol: float
) -> Float[Array, "nu nv d"]:
    """The same, linear in `right` for forward and reverse mode."""
    preconditioner = jax.lax.stop_gradient(preconditioner)

    def solve(apply: Operator, right: Array) -> Array:
        return solve_newton(apply, preconditioner, right, rtol)

    return jax.lax.custom_linear_solve(apply, right, solve=solve, transpose_solve=solve)
