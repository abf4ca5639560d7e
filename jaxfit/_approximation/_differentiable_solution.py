"""The solution of a linear least-squares problem as a function of everything in it, in both modes."""

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._approximation._linear_least_squares import LeastSquaresProblem
from jaxfit._normal_equations import normal_solver
from jaxfit._unrolling import constant


def unrolled_solution(
    problem: LeastSquaresProblem,
) -> tuple[Float[Array, "nu nv d"], Float[Array, ""]]:
    """The net and the shift, as any `AbstractLeastSquares` gives them: all agree to rounding."""
    normal, net = problem.normal, problem.net
    right = jnp.where(normal.free[:, :, None], problem.system.half_gradient(net), 0.0)
    solver = normal_solver(normal)
    factors = solver.init(constant(normal), {})
    step = lax.custom_linear_solve(
        normal.mv, right, lambda _, right: solver.compute(factors, right, {})[0], symmetric=True
    )
    return net - step, constant(getattr(factors, "shift", jnp.zeros((), net.dtype)))
