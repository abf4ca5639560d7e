"""The collocation system with a parameter pair for every point, and parameter correction."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._closest import FOOT_STEPS, Newton, project
from jaxfit._fit._history import ErrorHistory
from jaxfit._interpolation._gmres import GmresLimits, append_errors, distances, gmres_solve
from jaxfit._interpolation._per_point_collocation import PointCollocation, point_collocation
from jaxfit._interpolation._solution_derivative import times_last
from jaxfit._interpolation._tensor_collocation import TensorCollocation
from jaxfit._splines._pieces import Axis, pieces_on


class CollocationProblem(eqx.Module):
    """The data, knots and preconditioner of the system."""

    data: Float[Array, "n m d"]
    knots: tuple[Array, Array]
    axes: tuple[Axis, Axis]
    tensor: TensorCollocation
    limits: GmresLimits

    def system(self, u: Array, v: Array) -> PointCollocation:
        """The collocation matrix at the parameters (u, v) of every point."""
        return point_collocation(self.axes, u, v)

    def errors(self, net: Array, u: Array, v: Array) -> Array:
        """Distances at the parameters."""
        return distances(self.data - times_last(self.system(u, v), net), self.limits.diagonal)


class Corrected(eqx.Module):
    """Everything that goes round the loop of corrections."""

    net: Array
    u: Array
    v: Array
    step: Array  # cycles of GMRES so far
    history: ErrorHistory
    number: Array  # of corrections
    change: Array
    lost: Array
    slow: Array


def solved_at(
    method: Any,
    problem: CollocationProblem,
    net: Array,
    u: Array,
    v: Array,
    step: Array,
    history: ErrorHistory,
) -> Corrected:
    """The system at these parameters, solved as well as it can be.

    It starts from `net`, that of `step` in `history`, where its errors still have to be entered.
    """
    system, precondition = problem.system(u, v), problem.tensor.factorised()
    history = append_errors(history, step, problem.errors(net, u, v))
    net, step, history = gmres_solve(
        lambda x: times_last(system, x),
        precondition,
        problem.data,
        net,
        step,
        history,
        problem.limits,
        method.restart,
    )
    zero = jnp.asarray(0, jnp.int32)
    far = jnp.asarray(jnp.inf, net.dtype)
    return Corrected(net, u, v, step, history, zero, far, zero, jnp.asarray(False))


def corrected(method: Any, problem: CollocationProblem, found: Corrected) -> Corrected:
    """Alternates closest points and a new solve.

    Stops when the parameters no longer change, or when neither their change nor the errors fall.
    """
    n, m, d = problem.data.shape
    limits = problem.limits
    target = problem.data.reshape(n * m, d).T
    still = 100 * float(jnp.finfo(target.dtype).eps)

    def goes_on(now: Corrected) -> Array:
        left = (now.number < method.max_corrections) & (now.step < limits.max_steps)
        return left & (now.change > still) & ~now.slow

    def correct(now: Corrected) -> Corrected:
        pieces = pieces_on(now.net, *problem.axes)
        start, steps = (now.u.reshape(-1), now.v.reshape(-1)), jnp.asarray(FOOT_STEPS, jnp.int32)
        feet = project(Newton(), pieces, target, *start, method.foot_tolerance * limits.diagonal, steps)
        u, v = feet.best_u.reshape(n, m), feet.best_v.reshape(n, m)
        change = jnp.maximum(jnp.max(jnp.abs(u - now.u)), jnp.max(jnp.abs(v - now.v)))
        new = solved_at(method, problem, now.net, u, v, now.step, now.history)
        before, after = now.history.at(now.step)[1], new.history.at(new.step)[1]
        slow = (change > 0.9 * now.change) & (after > 0.9 * before)
        lost = jnp.sum(~feet.converged, dtype=jnp.int32)
        return Corrected(new.net, u, v, new.step, new.history, now.number + 1, change, lost, slow)

    return lax.while_loop(goes_on, correct, found)
