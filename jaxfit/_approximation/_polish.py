"""Newton steps on G, from the surface that a fit ended with to the one it would come to rest at."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._damping import longest_moves
from jaxfit._approximation._stationarity_residual import (
    FeetInRows,
    feet_in_rows,
    stationarity_residual,
)
from jaxfit._approximation._stationarity_system import StationaritySystem, stationarity_system
from jaxfit._cells import distances_at
from jaxfit._closest import Newton
from jaxfit._fit._feet import measure_feet
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._precision import default_foot_tolerance

# Accuracy of the linear systems of the steps: the least, which costs fewest products over all steps, and the
# most where the next step is to be the last.
ACCURACY, LAST_ACCURACY, MOST_CYCLES = 1e-2, 0.1, 1
REACH = 0.6  # of the distance between control points: the longest move in a step
# The ratio of the actual to the predicted work: above GOOD the shift falls, below POOR it rises.
GOOD, POOR, LOWERED, RAISED = 0.75, 0.25, 0.3, 4.0
FIRST_SHIFT, TAKEN_BACK, LEAST_SHIFT, MOST_SHIFT = 1e-4, 10.0, 1e-8, 1e2
GROWTH = 4.0  # of |G| in an accepted step
# Where |G| is still more than FAR of its terms after so many steps, or a tenth of all that are allowed, the
# surface at rest is another one.
FAR, PATIENCE = 0.5, 10


class PolishedFit(eqx.Module):
    """The surface at rest, its feet, |G| over the norms of its terms, and the linear system there."""

    net: Float[Array, "nu nv d"]
    projection: FootPoints
    system: StationaritySystem
    stationarity: Float[Array, ""]


class _Accepted(eqx.Module):
    net: Float[Array, "nu nv d"]
    projection: FootPoints
    value: Float[Array, "nu nv d"]  # G
    size: Float[Array, ""]  # its norm
    terms: Float[Array, ""]
    goal: Float[Array, ""]


class _State(eqx.Module):
    """The last accepted net; the next one to try, or that one again after a rejection (`again`)."""

    accepted: _Accepted
    system: StationaritySystem  # at the accepted net
    trial: Float[Array, "nu nv d"]
    predicted: Float[Array, ""]
    shift: Float[Array, ""]
    steps: Int[Array, ""]
    again: Bool[Array, ""]
    begun: Bool[Array, ""]
    done: Bool[Array, ""]


def polished(
    method: AbstractIterativeMethod,
    goal: Float[Array, ""],
    most: Int[Array, ""],
    problem: Problem,
    surface: WorkingSurface,
    state: Any,
    projection: FootPoints,
) -> PolishedFit:
    r"""Newton steps until G, relative to its terms, is below `goal`, or `most` steps, or nothing helps, or
    the surface is still far from rest after a tenth of them.

    A step solves $(G' + \mu M)\, \delta P = -G$, with the normal matrix M at fixed parameters. It is accepted
    where $(G_0 + G_1) \cdot \delta P < 0$. To third order that is twice the change of the objective of which
    G is the gradient, and it needs no such objective. mu is 0 unless steps are rejected.
    """
    problem, surface, state, projection = jax.tree.map(jnp.asarray, (problem, surface, state, projection))
    still = surface.control_points

    def found_at(
        there: WorkingSurface, here: FootPoints, shift: Array
    ) -> tuple[FeetInRows, StationaritySystem]:
        places = here.u, here.v
        feet = feet_in_rows(there, problem, *places)
        return feet, stationarity_system(method, state, there, problem, feet.rows, places, here.error, shift)

    def advance(now: _State) -> _State:
        old, there = now.accepted, surface.moved_to(now.trial)
        here = _measured(method, problem, there, old.projection)
        feet, system = found_at(there, here, now.shift)
        free = jnp.where(now.begun, now.system.free, system.free)  # the same for all steps
        system = eqx.tree_at(lambda s: s.free, system, free)

        def residual(net: Array) -> tuple[Array, Any]:
            moved = surface.moved_to(net)
            found = stationarity_residual(method, state, moved, problem, feet, free, still)
            return found.value, (found.terms, jnp.maximum(goal * found.terms, found.rounding))

        value, apply, (terms, least) = jax.linearize(residual, now.trial, has_aux=True)
        new = _Accepted(now.trial, here, value, jnp.sqrt(jnp.sum(value**2)), terms, least)
        work = 0.5 * jnp.sum((old.value + value) * (now.trial - old.net))
        good = now.again | (new.size <= least) | ((work < 0) & (new.size < GROWTH * old.size))
        shift = _next_shift(now, work, good, new.size / jnp.maximum(old.size, least))

        def step() -> tuple[Array, Array]:
            wanted = jnp.clip(LAST_ACCURACY * least / new.size, ACCURACY, LAST_ACCURACY)
            solution, image = system.solved(apply, -value, shift, wanted, MOST_CYCLES)
            share = _share_within_reach(surface.moved_to(now.trial), solution)
            move = share * solution
            return now.trial + move, jnp.sum(move * (value + 0.5 * share * image))

        done = good & ((new.size <= least) | (now.steps >= most))
        trial, predicted = lax.cond(good & ~done, step, lambda: (old.net, jnp.zeros_like(work)))
        new, system = jax.tree.map(lambda x, y: jnp.where(good, x, y), (new, system), (old, now.system))
        far = (now.steps >= jnp.maximum(PATIENCE, most // 10)) & (new.size > FAR * new.terms)
        ended = done | (shift > MOST_SHIFT) | far
        return _State(new, system, trial, predicted, shift, now.steps + good, ~good, yes, ended)

    nothing, yes = jnp.zeros((), still.dtype), jnp.asarray(True)
    first = _Accepted(still, projection, jnp.zeros_like(still), nothing + jnp.inf, nothing, nothing)
    unknown = jax.eval_shape(found_at, surface, projection, nothing)[1]
    system = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), unknown)
    begin = _State(first, system, still, nothing, nothing, jnp.asarray(0, jnp.int32), yes, ~yes, ~yes)
    last = lax.while_loop(lambda now: ~now.done, advance, begin)
    end = last.accepted
    share = end.size / jnp.where(end.terms > 0, end.terms, 1.0)
    return PolishedFit(end.net, end.projection, last.system, share)


def _next_shift(now: _State, work: Array, good: Array, fall: Array) -> Array:
    """mu of the next step, from the work that this one was predicted to do, and the ratio of |G|."""
    ratio = work / jnp.where(now.predicted < 0, now.predicted, -1.0)
    lowered = jnp.minimum(LOWERED, fall)
    factor = jnp.where(ratio > GOOD, lowered, jnp.where(ratio < POOR, RAISED, 1.0))
    fallen = factor * now.shift
    fallen = jnp.where(fallen < LEAST_SHIFT, 0.0, fallen)
    taken_back = jnp.maximum(TAKEN_BACK * now.shift, FIRST_SHIFT)
    return jnp.where(now.again, now.shift, jnp.where(good, fallen, taken_back))


def _share_within_reach(surface: WorkingSurface, move: Float[Array, "nu nv d"]) -> Float[Array, ""]:
    """The share of the move with which no control point comes too near to its neighbours."""
    length = jnp.sqrt(jnp.sum(move**2, axis=-1))
    longest = longest_moves(surface.control_points, REACH, surface.used)
    return jnp.min(jnp.where(length > longest, longest / jnp.where(length > 0, length, 1.0), 1.0))


def _measured(
    method: AbstractIterativeMethod, problem: Problem, surface: WorkingSurface, before: FootPoints
) -> FootPoints:
    """Feet, converged as far as a derivative needs, or without feet the errors at the parameters."""
    if method.finds_feet:
        tolerance = default_foot_tolerance(problem.target.dtype)
        return measure_feet(Newton(), problem, surface.pieces, before, tolerance)
    distance = distances_at(surface.pieces, before.u, before.v, problem.target, problem.real)
    return eqx.tree_at(lambda p: p.error, before, distance)
