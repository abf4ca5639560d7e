"""Linear systems with the derivative of G: matrix-free GMRES, preconditioned by the Gauss-Newton matrix."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._approximation._distance_rows import normal_equations
from jaxfit._cells import Rows
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import (
    CoupledPreconditioner,
    Operator,
    Stencil,
    coupled_preconditioner,
    free_points,
    gmres,
)

RESTART, MOST_CYCLES = 120, 8  # of GMRES: a restart forgets, and doubles the number of products
WORST = 1e-4  # the residual that a derivative may leave
# The share of the rows at fixed parameters in the preconditioner: what curvature adds along the surface.
DAMPING = 1e-3


class StationaritySystem(eqx.Module):
    """What is known about the derivative of G: a preconditioner, and the control points that G determines.

    `fixed` is the normal matrix at fixed parameters. All are symmetric and serve the transposed system, too.
    """

    preconditioner: CoupledPreconditioner
    fixed: Stencil
    free: Bool[Array, "nu nv"]

    def solved(
        self, apply: Operator, right: Array, shift: Any, rtol: Any, most_cycles: int
    ) -> tuple[Float[Array, "nu nv d"], Float[Array, "nu nv d"]]:
        """x with (A + shift fixed) x = right, for A or its transpose, and A x."""
        free = self.free[:, :, None]

        def shifts(x: Array) -> Array:
            return jnp.where(free, shift * self.fixed(jnp.where(free, x, 0.0)), 0.0)

        def shifted(x: Array) -> Array:
            return apply(x) + shifts(x)

        found = gmres(shifted, self.preconditioner, right, RESTART, rtol, most_cycles)
        return found.net, found.image - shifts(found.net)

    def solved_differentiably(self, apply: Operator, right: Array, rtol: float) -> Float[Array, "nu nv d"]:
        """x with A x = right, linear in `right` for forward and reverse mode; NaN where it was not found."""
        system = jax.lax.stop_gradient(self)

        def solve(apply: Operator, right: Array) -> Array:
            found = gmres(apply, system.preconditioner, right, RESTART, rtol, MOST_CYCLES)
            return jnp.where(found.left <= WORST, found.net, jnp.nan)

        return jax.lax.custom_linear_solve(apply, right, solve=solve, transpose_solve=solve)


def stationarity_system(
    method: AbstractIterativeMethod,
    state: Any,
    surface: WorkingSurface,
    problem: Problem,
    rows: Rows,
    feet: tuple[Array, Array],
    error: Float[Array, " points"],
    shift: Any = 0.0,
) -> StationaritySystem:
    """With the factors of the Gauss-Newton matrix, whose rows are blended with those at fixed parameters.

    `rows` hold the points at their feet.
    """
    condition = method.stationarity(problem, surface, state, error)
    damping = jnp.minimum(DAMPING + shift, 1.0) if method.finds_feet else 1.0
    damping = jnp.asarray(damping, error.dtype)
    weighted = *feet, condition.weight
    matrix = normal_equations(problem, surface.pieces, rows, *weighted, damping).matrix
    fixed = matrix.at_fixed_parameters(damping)
    between = fixed.times(jnp.sqrt(damping))  # as in a step of the fit
    if condition.penalty is not None:
        stiffness = condition.penalty.system(surface.control_points)[0]
        matrix, fixed = matrix.plus(stiffness), fixed.plus(stiffness)
        between = between.plus(stiffness)
    free = free_points(fixed, condition.held)
    return StationaritySystem(coupled_preconditioner(matrix, between, free), fixed, free)
