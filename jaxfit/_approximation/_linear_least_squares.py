"""`GaussNewton` and `LevenbergMarquardt`: solvers of the least-squares problem of `StandardApproximation`.

All minimise the sum of squares of the same residual, [sqrt(w) (A P - Q); sqrt(lambda) L P], and agree to
rounding. None needs a dense Jacobian.
"""

from abc import abstractmethod
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._checks import check_number
from jaxfit._normal_equations import NormalOperator, RegularisedSystem, Stencil, free_points, normal_solver
from jaxfit._varying import varying_axes


class LeastSquaresProblem(eqx.Module):
    """A system with its normal matrix on the free control points; the others are as in `net`."""

    system: RegularisedSystem
    normal: NormalOperator
    net: Float[Array, "nu nv d"]

    def residual(self, net: Float[Array, "nu nv d"]) -> Any:
        """The residual of a net; control points that are not free are those of `self.net`."""
        return self.system.residual(jnp.where(self.normal.free[:, :, None], net, self.net))


def least_squares_problem(
    system: RegularisedSystem, held: Bool[Any, "nu nv"], net: Float[Array, "nu nv d"]
) -> LeastSquaresProblem:
    """The problem of correcting `net`, whose control points `held` do not move."""

    def matrix(system: RegularisedSystem) -> tuple[Stencil, Array]:
        stencil = system.stencil()
        return stencil, free_points(stencil, held)

    stencil, free = materialise(system.root[0, 0] >= 0, matrix, system)
    return LeastSquaresProblem(system, NormalOperator(stencil, free, net.shape[2]), net)


class AbstractLeastSquares(eqx.Module):
    """A way to solve a linear least-squares problem from a net near the solution."""

    @abstractmethod
    def __call__(self, problem: LeastSquaresProblem) -> tuple[Float[Array, "nu nv d"], Float[Array, ""]]:
        """The least-squares net, and the shift of a singular matrix as a share of its diagonal."""


class GaussNewton(AbstractLeastSquares):
    """`optimistix.GaussNewton` with the structured normal equations as its linear solver (the default).

    The residual is linear, so one step solves it: moments of the points within cells, one Cholesky
    factorisation of the normal matrix (or CG for very large nets), one product with the transposed Jacobian.
    This is a linear solver of `StandardApproximation`, not a fitting method of its own.

    Examples
    --------
    >>> jf.StandardApproximation().solver
    GaussNewton()
    """

    def __call__(self, problem: LeastSquaresProblem) -> tuple[Float[Array, "nu nv d"], Float[Array, ""]]:
        """One step."""
        import optimistix as optx

        linear = StructuredSolver(problem)
        if varying_axes(problem.system.target):  # inside jax.shard_map, where optimistix cannot run
            step, _, _ = linear.compute(StructuredSolver.Side(), problem.residual(problem.net), {})
            return _free_part(problem, problem.net - step), linear.shift
        # The residual is linear, so the first step is the solution: no norm and no acceptance test is needed.
        solver: Any = optx.GaussNewton(1e-8, 1e-8, norm=lambda _: jnp.zeros(()), linear_solver=linear)
        return _free_part(problem, _solution(solver, problem, 1).state.y_eval), linear.shift


class LevenbergMarquardt(AbstractLeastSquares):
    """`optimistix.LevenbergMarquardt`, matrix-free: CG on products with the Jacobian and its transpose.

    It does not use the structure and takes many passes over the points: an independent check, and a fallback
    for systems too large to factor.

    Parameters
    ----------
    tolerance : float
        Relative and absolute tolerance of the control points, in units of the data's extent (default 1e-10).
    max_steps : int
        The largest number of steps (default 60).

    Raises
    ------
    ValueError
        If `tolerance` is negative or not finite, or `max_steps` no whole number of at least 1.

    Examples
    --------
    >>> jf.StandardApproximation(solver=jf.LevenbergMarquardt()).solver.max_steps
    60
    """

    tolerance: float = 1e-10
    max_steps: int = 60

    def __check_init__(self) -> None:
        check_driver(self)

    def __call__(self, problem: LeastSquaresProblem) -> tuple[Float[Array, "nu nv d"], Float[Array, ""]]:
        """Run optimistix's driver."""
        import optimistix as optx

        eps = float(jnp.finfo(problem.net.dtype).eps)
        linear = lx.Normal(lx.CG(rtol=10 * eps, atol=10 * eps, max_steps=problem.net.size))
        tolerance: Any = jnp.maximum(self.tolerance, 10 * eps)
        solver: Any = optx.LevenbergMarquardt(tolerance, tolerance, linear_solver=linear)
        net = _solution(solver, problem, self.max_steps).value
        return _free_part(problem, net), jnp.zeros((), net.dtype)


def check_driver(solver: Any) -> None:
    """Raise unless the options that iterative drivers have in common are valid."""
    check_number("tolerance", solver.tolerance, 0.0)
    check_number("max_steps", solver.max_steps, 1, whole=True)


def _solution(solver: Any, problem: LeastSquaresProblem, steps: int) -> Any:
    import optimistix as optx

    # The driver stores the arguments of the residual instead of a dozen arrays over the points.
    @partial(jax.checkpoint, prevent_cse=False)
    def residual(net: Array, problem: LeastSquaresProblem) -> Any:
        return problem.residual(net)

    return optx.least_squares(residual, solver, problem.net, problem, max_steps=steps, throw=False)


def _free_part(problem: LeastSquaresProblem, net: Array) -> Array:
    """The free control points of `net`, and the others as they were."""
    return jnp.where(problem.normal.free[:, :, None], net, problem.net)


class StructuredSolver(lx.AbstractLinearSolver):
    """Solves J x = r in the sense of least squares for the Jacobian J of one known problem.

    The matrix J^T J is known as a stencil and factored once, before the driver starts. The operator that the
    driver passes is not used.
    """

    problem: LeastSquaresProblem
    state: Any

    class Side(eqx.Module):
        """Which of J and its transpose is solved for."""

        transposed: bool = eqx.field(static=True, default=False)

    def __init__(self, problem: LeastSquaresProblem) -> None:
        self.problem = problem
        self.state = self._solver.init(problem.normal, {})

    @property
    def _solver(self) -> Any:
        return normal_solver(self.problem.normal)

    @property
    def shift(self) -> Float[Array, ""]:
        """The shift of a singular matrix, as a share of its diagonal."""
        return getattr(self.state, "shift", jnp.zeros((), self.problem.net.dtype))

    def init(self, operator: Any, options: dict[str, Any]) -> Side:
        """No work: the matrix has been factored."""
        return self.Side()

    def compute(self, state: Side, vector: Any, options: dict[str, Any]) -> Any:
        """(J^T J)^-1 J^T r, or of the transposed problem the least solution, J (J^T J)^-1 r."""
        problem = self.problem
        right = vector if state.transposed else problem.system.adjoint(vector)
        right = jnp.where(problem.normal.free[:, :, None], right, 0.0)
        net, result, stats = self._solver.compute(self.state, right, options)
        if state.transposed:
            net = jax.jvp(problem.residual, (problem.net,), (net,))[1]
        return net, result, stats

    def transpose(self, state: Side, options: dict[str, Any]) -> Any:
        """The same factors serve."""
        return self.Side(not state.transposed), options

    def conj(self, state: Side, options: dict[str, Any]) -> Any:
        """Everything is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """True: a singular matrix is shifted."""
        return True
