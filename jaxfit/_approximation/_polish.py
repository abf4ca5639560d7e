"""Newton steps on G, from the surface that a fit ended with to the one it would come to rest at."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._damping import longest_moves
from jaxfit._approximation._linearisation import Linearisation, linearisation
from jaxfit._approximation._stationarity_system import StationaritySystem
from jaxfit._checks import is_concrete
from jaxfit._closest import Newton, compile_search_ahead
from jaxfit._compile import compiled
from jaxfit._fit._feet import measure_feet, measure_feet_on_host
from jaxfit._fit._foot_points import FootPoints
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


class Polish(eqx.Module):
    """A fit that is to be brought to rest.

    `numbers` are the dynamic fields of its method. |G|, relative to its terms, should fall to `goal` in at
    most so many steps.
    """

    numbers: Any
    goal: Float[Any, ""]
    most: Int[Any, ""]
    problem: Problem
    surface: WorkingSurface
    state: Any
    projection: FootPoints


class PolishedFit(eqx.Module):
    """The surface at rest, its feet, G near it, and |G| over the norms of its terms."""

    net: Float[Any, "nu nv d"]
    projection: FootPoints
    near: Linearisation
    stationarity: Float[Any, ""]


class _Accepted(eqx.Module):
    net: Float[Any, "nu nv d"]
    projection: FootPoints
    value: Float[Any, "nu nv d"]  # G
    size: Float[Any, ""]  # its norm
    stationarity: Float[Any, ""]  # that over the norms of its terms


class _State(eqx.Module):
    """The last accepted net; the next one to try, or that one again after a rejection (`again`)."""

    accepted: _Accepted
    free: Bool[Any, "nu nv"]
    trial: Float[Any, "nu nv d"]
    predicted: Float[Any, ""]
    shift: Float[Any, ""]
    steps: Int[Any, ""]
    again: Bool[Any, ""]
    done: Bool[Any, ""]


def polished(rest: Any, polish: Polish) -> PolishedFit:
    r"""Newton steps until G, relative to its terms, is below `goal`, or `most` steps, or nothing helps, or
    the surface is still far from rest after a tenth of them. `rest` are the static fields of the method.

    A step solves $(G' + \mu M)\, \delta P = -G$, with the normal matrix M at fixed parameters. It is accepted
    where $(G_0 + G_1) \cdot \delta P < 0$. To third order that is twice the change of the objective of which
    G is the gradient, and it needs no such objective. mu is 0 unless steps are rejected.

    Where all is concrete the host calls the programs of a step one by one: the derivative and the search for
    closest points need them, too.
    """
    if is_concrete(polish):
        last, near = _at_rest_on_host(rest, polish)
    else:
        last, system = _at_rest_in_program(rest, polish)
        near = eqx.tree_at(lambda x: x.system, _near(rest, polish, last), system)
    end = last.accepted
    return PolishedFit(end.net, end.projection, near, end.stationarity)


def polish_ahead(rest: Any, polish: Polish) -> PolishedFit:
    """Begin to compile what `polished` calls, all concrete; the like of what it returns."""
    begin = _first_state(polish)
    args = _at_trial(rest, polish, begin, polish.projection)
    linearisation.ahead(*args)
    near = linearisation.like_result(*args)
    _advanced.ahead(polish.goal, polish.most, polish.surface, begin, near, polish.projection)
    if _finds_feet(rest, polish):
        surface, count = polish.surface, int(np.sum(polish.problem.real))
        compile_search_ahead(Newton(), surface.control_points, *surface.axes, count)
    return PolishedFit(begin.trial, polish.projection, near, polish.goal)


@partial(jax.jit, static_argnums=0)
def _at_rest_in_program(rest: Any, polish: Polish) -> tuple[_State, StationaritySystem]:
    """The state at rest and the system there; on a CPU the fits of a batch one after the other."""

    def whole(polish: Polish) -> tuple[_State, StationaritySystem]:
        step = partial(_step, rest, polish)
        last = lax.while_loop(lambda now: ~now.done, lambda now: step(now)[0], _first_state(polish))
        return last, _near(rest, polish, last).system

    if jax.default_backend() == "cpu":
        whole = jax.custom_batching.sequential_vmap(whole)
    return whole(polish)


def _at_rest_on_host(rest: Any, polish: Polish) -> tuple[_State, Linearisation]:
    now = _first_state(polish)
    while True:
        now, near = _step(rest, polish, now)
        if now.done:
            return now, _near(rest, polish, now) if now.again else near
        del near  # before there is the next one


def _first_state(polish: Polish) -> _State:
    net = polish.surface.control_points
    xp: Any = np if is_concrete(polish) else jnp  # NumPy's arrays cost no calls of their own
    zero, yes = xp.zeros((), net.dtype), xp.ones((), bool)
    begin = _Accepted(net, polish.projection, xp.zeros_like(net), zero + xp.inf, zero + xp.inf)
    free = xp.ones(net.shape[:2], bool)
    return _State(begin, free, net, zero, zero, xp.zeros((), np.int32), yes, ~yes)


def _step(rest: Any, polish: Polish, now: _State) -> tuple[_State, Linearisation]:
    """The next state, and G near the trial of this one."""
    here = now.accepted.projection
    if _finds_feet(rest, polish):  # as converged as a derivative needs
        there, tolerance = polish.surface.moved_to(now.trial), default_foot_tolerance(now.trial.dtype)
        if is_concrete(polish):
            here = measure_feet_on_host(Newton(), polish.problem, there, here, tolerance)
        else:
            here = measure_feet(Newton(), polish.problem, there.pieces, here, tolerance)
    near = linearisation(*_at_trial(rest, polish, now, here))
    return _advanced(polish.goal, polish.most, polish.surface, now, near, here), near


def _finds_feet(rest: Any, polish: Polish) -> bool:
    return eqx.combine(polish.numbers, rest).finds_feet


def _at_trial(rest: Any, polish: Polish, now: _State, here: FootPoints) -> tuple[Any, ...]:
    """The arguments of `linearisation` at the next net to try, whose feet are `here`."""
    fit = polish.numbers, polish.problem, polish.surface, polish.state
    return rest, *fit, now.trial, here, now.shift, now.free, now.steps


def _near(rest: Any, polish: Polish, last: _State) -> Linearisation:
    """At the net that was accepted last, without a shift."""
    end, zero = last.accepted, np.zeros((), last.shift.dtype)
    there = dataclasses.replace(last, trial=end.net, shift=zero)
    return linearisation(*_at_trial(rest, polish, there, end.projection))


@compiled
def _advanced(
    goal: Array, most: Array, surface: WorkingSurface, now: _State, near: Linearisation, here: FootPoints
) -> _State:
    """Whether the trial is accepted, and from the net that is, the next one to try."""
    old, value = now.accepted, near.value
    least = jnp.maximum(goal * near.terms, near.rounding)
    size = jnp.sqrt(jnp.sum(value**2))
    new = _Accepted(now.trial, here, value, size, size / jnp.where(near.terms > 0, near.terms, 1.0))
    work = 0.5 * jnp.sum((old.value + value) * (now.trial - old.net))
    good = now.again | (new.size <= least) | ((work < 0) & (new.size < GROWTH * old.size))
    shift = _next_shift(now, work, good, new.size / jnp.maximum(old.size, least))

    def step() -> tuple[Array, Array]:
        wanted = jnp.clip(LAST_ACCURACY * least / new.size, ACCURACY, LAST_ACCURACY)
        solution, image = near.system.solved(near.change, -value, shift, wanted, MOST_CYCLES)
        share = _share_within_reach(surface.moved_to(now.trial), solution)
        move = share * solution
        return now.trial + move, jnp.sum(move * (value + 0.5 * share * image))

    done = good & ((new.size <= least) | (now.steps >= most))
    trial, predicted = lax.cond(good & ~done, step, lambda: (old.net, jnp.zeros_like(work)))
    new = jax.tree.map(lambda x, y: jnp.where(good, x, y), new, old)
    far = (now.steps >= jnp.maximum(PATIENCE, most // 10)) & (new.stationarity > FAR)
    ended = done | (shift > MOST_SHIFT) | far
    return _State(new, near.system.free, trial, predicted, shift, now.steps + good, ~good, ended)


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
