"""Newton steps on G, from the surface that a fit ended with to the one it would come to rest at."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._damping import within_reach
from jaxfit._approximation._newton_system import NewtonPreconditioner, newton_preconditioner, solve_newton
from jaxfit._approximation._stationarity_residual import (
    feet_in_rows,
    stationarity_residual,
)
from jaxfit._cells import values_at
from jaxfit._closest import Newton
from jaxfit._fit._adjoints import ImplicitAdjoint
from jaxfit._fit._feet import measure_feet
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._problem import Problem
from jaxfit._fit._projection import Projection
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._precision import default_foot_tolerance

ACCURACY = 1e-4  # of the linear systems: the first steps need no more, the last ones are repeated
REACH = 0.6  # of the distance between control points: the longest move in a step
SHORTER, SHORTEST = 0.25, 1e-3  # a step that does not lower |G| is taken again by this factor, down to that


class PolishedFit(eqx.Module):
    """The surface at rest, its feet, and |G| over the norms of its terms; `free` control points determine G."""

    net: Float[Array, "nu nv d"]
    projection: Projection
    free: Bool[Array, "nu nv"]
    stationarity: Float[Array, ""]


class _Step(eqx.Module):
    net: Float[Array, "nu nv d"]
    projection: Projection
    size: Float[Array, ""]  # |G|
    goal: Float[Array, ""]
    terms: Float[Array, ""]
    number: Int[Array, ""]
    failed: Bool[Array, ""]


def polished(
    method: AbstractIterativeMethod,
    adjoint: ImplicitAdjoint,
    problem: Problem,
    surface: WorkingSurface,
    state: Any,
    projection: Projection,
) -> PolishedFit:
    """Newton steps until G is small enough or does not fall any more."""
    problem, surface, state, projection = jax.tree.map(jnp.asarray, (problem, surface, state, projection))
    still = surface.control_points
    system = newton_preconditioner(
        method, state, surface, problem, (projection.u, projection.v), projection.error
    )
    free = system.free
    goal = adjoint.goal(still.dtype)

    def at(net: Array, before: Projection) -> tuple[Projection, Array, Array, Array]:
        here = _measured(method, problem, surface.moved_to(net), before)
        feet = feet_in_rows(surface, problem, here.u, here.v)
        found = stationarity_residual(method, state, surface.moved_to(net), problem, feet, free, still)
        least = jnp.maximum(goal * found.terms, found.rounding)
        return here, jnp.sqrt(jnp.sum(found.value**2)), least, found.terms

    def direction(step: _Step) -> Array:
        there, here = surface.moved_to(step.net), step.projection
        factors = newton_preconditioner(method, state, there, problem, (here.u, here.v), here.error)
        factors = NewtonPreconditioner(factors.factors, free)
        feet = feet_in_rows(surface, problem, here.u, here.v)

        def value(net: Array) -> Array:
            return stationarity_residual(
                method, state, surface.moved_to(net), problem, feet, free, still
            ).value

        right, apply = jax.linearize(value, step.net)
        move = solve_newton(apply, factors, -right, ACCURACY)
        return _shortened(step.net, move)

    def advance(step: _Step) -> _Step:
        move = direction(step)

        def trial(tried: tuple[Array, _Step]) -> tuple[Array, _Step]:
            share, _ = tried
            net = step.net + share * move
            here, size, least, terms = at(net, step.projection)
            new = _Step(net, here, size, least, terms, step.number + 1, jnp.asarray(False))
            return SHORTER * share, new

        def missed(tried: tuple[Array, _Step]) -> Array:
            share, new = tried
            return ~(new.size < step.size) & (share >= SHORTEST)

        first = trial((jnp.ones((), still.dtype), step))
        _, new = lax.while_loop(missed, trial, first)
        better = new.size < step.size
        kept = eqx.tree_at(lambda s: s.failed, step, jnp.asarray(True))
        return jax.tree.map(lambda x, y: jnp.where(better, x, y), new, kept)

    def unfinished(step: _Step) -> Array:
        return (step.size > step.goal) & ~step.failed & (step.number < adjoint.polish_steps)

    here, size, least, terms = at(still, projection)
    begin = _Step(still, here, size, least, terms, jnp.asarray(0, jnp.int32), jnp.asarray(False))
    end = lax.while_loop(unfinished, advance, begin)
    share = end.size / jnp.where(end.terms > 0, end.terms, 1.0)
    return PolishedFit(end.net, end.projection, free, share)


def _shortened(net: Float[Array, "nu nv d"], move: Float[Array, "nu nv d"]) -> Float[Array, "nu nv d"]:
    """The move, shorter where a control point would come too near to its neighbours."""
    length, limit = (jnp.sqrt(jnp.sum(x**2, axis=-1)) for x in (move, within_reach(net, move, REACH)))
    return move * jnp.min(jnp.where(length > limit, limit / jnp.where(length > 0, length, 1.0), 1.0))


def _measured(
    method: AbstractIterativeMethod, problem: Problem, surface: WorkingSurface, before: Projection
) -> Projection:
    """Feet, converged as far as a derivative needs, or without feet the errors at the parameters."""
    if method.finds_feet:
        tolerance = default_foot_tolerance(problem.target.dtype)
        return measure_feet(Newton(), problem, surface.pieces, before, tolerance)
    residual = values_at(surface.pieces, before.u, before.v) - problem.target
    distance = jnp.sqrt(jnp.sum(jnp.where(problem.real[None], residual, 0.0) ** 2, axis=0))
    return eqx.tree_at(lambda p: p.error, before, distance)
