"""Sums of error vectors over the control points, with feet converged."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._control_point_sums import Pulls, pull
from jaxfit._approximation._foot_updates import Arrive, Stay
from jaxfit._cells import few_of
from jaxfit._closest import AbstractFootMethod
from jaxfit._fit._measure import measure_feet
from jaxfit._fit._problem import Problem
from jaxfit._fit._projection import Projection
from jaxfit._splines._pieces import Pieces

PORTION = 64  # of those feet that one evaluation does not prove


def pull_at_feet(
    method: AbstractFootMethod,
    problem: Problem,
    pieces: Pieces,
    before: Projection,
    foot_tolerance: Float[Any, ""],
    resting: Bool[Any, " points"],
    weigh: Callable[[Array, Array], Array],
) -> tuple[Projection, Pulls, Int[Array, ""]]:
    """Feet from the last ones, converged on the surface, the sums there, and how many points are in them.

    Most feet are near, and the pass that sums proves that it has found them; `method` finds the others.
    """
    move = Arrive(foot_tolerance * problem.diagonal)
    pulled = pull(problem, pieces, before.u, before.v, before.error, resting, weigh, move)
    feet, looks = pulled.feet, pulled.looks
    done = resting | (looks > 0)
    looked = jnp.where(resting, 0, jnp.where(done, looks, Arrive.looks)).astype(jnp.int32)
    u, v = jnp.where(resting, jnp.stack([before.u, before.v]), feet[:2])
    most = Projection(u, v, feet[2], looked, done, before.active, jnp.asarray(True))
    return _others(method, problem, pieces, before, most, foot_tolerance, weigh, pulled.pulls, pulled.active)


def _others(
    method: AbstractFootMethod,
    problem: Problem,
    pieces: Pieces,
    before: Projection,
    most: Projection,
    foot_tolerance: Any,
    weigh: Callable[[Array, Array], Array],
    pulls: Pulls,
    active: Array,
) -> tuple[Projection, Pulls, Array]:
    """With the feet that have not been found and what they add, some at a time: mostly there are very few.

    They start from where they were: where the pass has taken them need not be downhill.
    """
    points = most.u.shape[0]
    names = ("u", "v", "error", "evaluations", "converged")

    def unfinished(carry: Any) -> Array:
        return jnp.any(carry[0])

    def portion(carry: Any) -> Any:
        left, total, sums, active = carry
        number = few_of(left, PORTION)
        at, known = jnp.minimum(number, points - 1), number == points
        some = problem.ordered(at)
        parts = {name: getattr(before, name)[at] for name in names}
        here = dataclasses.replace(before, **parts)
        feet = measure_feet(method, some, pieces, here, foot_tolerance, known, borders=False)
        stay = pull(some, pieces, feet.u, feet.v, feet.error, known, weigh, Stay())
        spent = feet.evaluations + most.evaluations[at]
        new = (feet.u, feet.v, feet.error, spent, feet.converged)
        total = jax.tree.map(lambda x, y: x.at[number].set(y, mode="drop"), total, new)
        left = left.at[number].set(False, mode="drop")
        return left, total, sums + stay.pulls.sums, active + stay.active

    begin = (~most.converged, tuple(getattr(most, x) for x in names), pulls.sums, active)
    _, parts, sums, active = lax.while_loop(unfinished, portion, begin)
    found = dict(zip(names, parts, strict=True))
    return dataclasses.replace(most, active=active, **found), Pulls(sums), active
