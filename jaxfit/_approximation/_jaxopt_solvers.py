"""Adapters to the least-squares drivers of `jaxopt`, which is imported when first used."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxfit._approximation._linear_least_squares import (
    AbstractLeastSquares,
    LeastSquaresProblem,
    check_driver,
)


class JaxoptGaussNewton(AbstractLeastSquares):
    """`jaxopt.GaussNewton`, matrix-free: CG on products with the Jacobian and its transpose.

    Parameters
    ----------
    tolerance : float
        The largest norm of the last step, over all control points, in units of the data's extent (default
        1e-10).
    max_steps : int
        The largest number of steps (default 20); each gains the accuracy of one CG solve, a factor of 1e5.

    Raises
    ------
    ValueError
        If `tolerance` is negative or not finite, or `max_steps` no whole number of at least 1.

    Examples
    --------
    >>> jf.StandardApproximation(solver=jf.JaxoptGaussNewton(max_steps=5)).solver.max_steps
    5
    """

    tolerance: float = 1e-10
    max_steps: int = 20

    def __check_init__(self) -> None:
        check_driver(self)

    def __call__(self, problem: LeastSquaresProblem) -> tuple[Float[Array, "nu nv d"], Float[Array, ""]]:
        """Run jaxopt's driver."""
        return _minimised("GaussNewton", problem, self.tolerance, self.max_steps)


class JaxoptLevenbergMarquardt(AbstractLeastSquares):
    """`jaxopt.LevenbergMarquardt`, matrix-free: CG on products with the Jacobian and its transpose.

    Parameters
    ----------
    tolerance : float
        The largest norm of the gradient, in units of the data's extent (default 1e-11).
    max_steps : int
        The largest number of steps (default 60).

    Raises
    ------
    ValueError
        If `tolerance` is negative or not finite, or `max_steps` no whole number of at least 1.

    Examples
    --------
    >>> jf.StandardApproximation(solver=jf.JaxoptLevenbergMarquardt()).solver.max_steps
    60
    """

    tolerance: float = 1e-11
    max_steps: int = 60

    def __check_init__(self) -> None:
        check_driver(self)

    def __call__(self, problem: LeastSquaresProblem) -> tuple[Float[Array, "nu nv d"], Float[Array, ""]]:
        """Run jaxopt's driver."""
        return _minimised("LevenbergMarquardt", problem, self.tolerance, self.max_steps)


def _minimised(name: str, problem: LeastSquaresProblem, tolerance: Any, steps: int) -> tuple[Array, Array]:
    """Runs jaxopt's driver of this name on the residual as one vector of the control points as one vector."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt says at import that it is not maintained
        import jaxopt

    def residual(vector: Array) -> Array:
        parts = jax.tree.leaves(problem.residual(vector.reshape(problem.net.shape)))
        return jnp.concatenate([x.reshape(-1) for x in parts])

    eps = float(jnp.finfo(problem.net.dtype).eps)
    driver = getattr(jaxopt, name)
    options = dict(
        maxiter=steps, tol=jnp.maximum(tolerance, 10 * eps), implicit_diff=False, jit=True, unroll=False
    )
    solver = driver(residual, **options)
    net = solver.run(problem.net.reshape(-1)).params.reshape(problem.net.shape)
    net = jnp.where(problem.normal.free[:, :, None], net, problem.net)
    return net, jnp.zeros((), net.dtype)
