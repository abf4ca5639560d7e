"""Preconditioned conjugate gradients on nets, for all solvers that are not direct."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._unrolling import unrolled

Operator = Callable[[Array], Array]
State = tuple[Array, Array, Array, Array, Array]

# Of unrolled fits: the residual in rounding units, and iterations.
ROUNDING, MOST_STEPS = 8.0, 1000


class CGSolution(NamedTuple):
    """An approximate solution, the residual that it leaves, and whether the tolerance is met."""

    net: Float[Array, "nu nv c"]
    residual: Float[Array, "nu nv c"]
    met: Bool[Array, ""]
    steps: Int[Array, ""]


def conjugate_gradients(
    matrix: Operator,
    right: Float[Array, "nu nv c"],
    preconditioner: Operator,
    rtol: float,
    max_steps: Any,
    coupled: bool,
) -> CGSolution:
    """Solves a positive semidefinite system from 0.

    Stops where the residual, in the norm of the preconditioner, is `rtol` times the right-hand side, after
    `max_steps` iterations, or where the matrix has no curvature. The quadratic model falls in every
    iteration, so any intermediate solution is a direction of descent. Unless the channels are `coupled`, each
    has its own step length.
    """
    if unrolled():
        return _exactly(matrix, right, preconditioner, coupled)
    return _iterate(matrix, right, preconditioner, rtol, max_steps, coupled)


def _exactly(matrix: Operator, right: Array, preconditioner: Operator, coupled: bool) -> CGSolution:
    """To rounding: the derivative is that of the solution, not of the iterations."""
    rtol = ROUNDING * float(jnp.finfo(right.dtype).eps)

    def solve(matrix: Operator, right: Array) -> Array:
        return _iterate(matrix, right, preconditioner, rtol, MOST_STEPS, coupled).net

    net = lax.custom_linear_solve(matrix, right, solve, symmetric=True)
    return CGSolution(net, jnp.zeros_like(right), jnp.asarray(True), jnp.asarray(0, jnp.int32))


def _iterate(
    matrix: Operator, right: Array, preconditioner: Operator, rtol: float, max_steps: Any, coupled: bool
) -> CGSolution:
    def inner(x: Array, y: Array) -> Array:
        return jnp.sum(x * y, axis=None if coupled else (0, 1), keepdims=True)

    def unfinished(state: State) -> Array:
        _, _, _, slope, steps = state
        return jnp.any(slope > goal) & (steps < max_steps)

    def step(state: State) -> State:
        net, left, along, slope, steps = state
        image = matrix(along)
        length = _ratio(slope, inner(along, image))
        net, left = net + length * along, left - length * image
        nearby = preconditioner(left)
        after = jnp.where(length > 0, inner(left, nearby), 0.0)
        return net, left, nearby + _ratio(after, slope) * along, after, steps + 1

    first = preconditioner(right)
    slope = inner(right, first)
    goal = rtol**2 * slope
    begin = (jnp.zeros_like(right), right, first, slope, jnp.asarray(0, jnp.int32))
    net, left, _, slope, steps = lax.while_loop(unfinished, step, begin)
    return CGSolution(net, left, jnp.all(slope <= goal) & jnp.all(jnp.isfinite(left)), steps)


def _ratio(x: Array, y: Array) -> Array:
    """x / y; 0 where y is not positive, as for a channel that is solved exactly."""
    return jnp.where(y > 0, x / jnp.where(y > 0, y, 1.0), 0.0)
