"""How error vectors pull, with feet converged."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Int

from jaxfit._closest import AbstractFootMethod
from jaxfit._fit._foot_moves import Arrive, Stay
from jaxfit._fit._loop import Ahead, Measured
from jaxfit._fit._measure import measure_feet
from jaxfit._fit._pull import Pulls, pull
from jaxfit._splines._pieces import Pieces

LEAD = 0.9  # feet start ahead by so much of their last move, which the next one resembles
FEW = 512  # so many points are moved on among themselves rather than among all


def pull_at_feet(
    method: AbstractFootMethod,
    problem: Any,
    pieces: Pieces,
    measured: Measured,
    resting: Bool[Any, " points"],
    weigh: Callable[[Array, Array], Array],
) -> tuple[Measured, Pulls, Int[Array, ""]]:
    """Feet from the last ones, converged on the surface, how they pull, and how many points do.

    Most feet are near, and the pass that gathers proves that it has found them; `method` finds the others.
    """
    (axis_u, axis_v), before = (pieces.axis_u, pieces.axis_v), jnp.stack([measured.u, measured.v])
    assert measured.ahead is not None
    start = before + LEAD * measured.ahead.drift
    u = jnp.clip(start[0], axis_u.breaks[0], axis_u.breaks[-1])
    v = jnp.clip(start[1], axis_v.breaks[0], axis_v.breaks[-1])
    # Whoever was found at the first look was in its row's cell; those at rest were not looked at.
    kept, rows = measured.ahead.kept, None
    if measured.poor is None:  # else others rest each time
        kept = kept.followed(pieces, u, v, resting, measured.steps != 1)
        rows = kept.rows
    feet, looks, pulls, active = pull(problem, pieces, u, v, measured.error, resting, weigh, Arrive(), rows)
    done = resting | (looks > 0)
    looked = jnp.where(resting, 0, jnp.where(done, looks, 1 + Arrive.again)).astype(jnp.int32)
    u, v = jnp.where(resting, before, feet[:2])
    most = Measured(u, v, feet[2], looked, done)
    further = partial(_others, method, problem, pieces, measured, most, weigh)
    here, more, others = lax.cond(
        jnp.all(done), lambda: (most, jnp.zeros_like(pulls.sums), 0 * active), further
    )
    ahead = Ahead(jnp.where(looks > 0, feet[:2] - before, 0.0), kept)
    here = eqx.tree_at(lambda m: m.ahead, here, ahead, is_leaf=lambda x: x is None)
    return here, Pulls(pulls.sums + more), active + others


def _others(
    method: AbstractFootMethod,
    problem: Any,
    pieces: Pieces,
    before: Measured,
    most: Measured,
    weigh: Callable[[Array, Array], Array],
) -> tuple[Measured, Array, Array]:
    """With the feet that have not been found, their sums, and how many points these are from.

    They start from where they were: where the pass has taken them need not be downhill.
    """
    points, done = most.u.shape[0], most.found

    def among(some: Any, here: Measured, known: Array) -> tuple[Measured, Array, Array]:
        feet = measure_feet(method, some, pieces, here, known, borders=False)
        stay = pull(some, pieces, feet.u, feet.v, feet.error, known, weigh, Stay())
        steps = jnp.where(known, 0, feet.steps + here.steps)
        return eqx.tree_at(lambda m: m.steps, feet, steps), stay[2].sums, stay[3]

    start = Measured(before.u, before.v, before.error, most.steps, before.found)

    def many() -> tuple[Measured, Array, Array]:
        feet, sums, active = among(problem, start, done)
        return jax.tree.map(lambda x, y: jnp.where(done, x, y), most, feet), sums, active

    def few() -> tuple[Measured, Array, Array]:
        number = jnp.nonzero(~done, size=FEW, fill_value=points)[0]
        at = jnp.minimum(number, points - 1)
        here = jax.tree.map(lambda x: x[at], start)
        feet, sums, active = among(problem.ordered(at), here, number == points)
        return jax.tree.map(lambda x, y: x.at[number].set(y, mode="drop"), most, feet), sums, active

    return lax.cond(jnp.sum(~done) <= FEW, few, many) if points > FEW else many()
