"""How error vectors pull, with feet converged."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Int

from jaxfit._approximation._control_point_sums import Pulls, pull
from jaxfit._approximation._foot_updates import Arrive, Stay
from jaxfit._cells import few_of
from jaxfit._closest import AbstractFootMethod
from jaxfit._fit._loop import Measured
from jaxfit._fit._measure import measure_feet
from jaxfit._splines._pieces import Pieces

PORTION = 64  # of those feet that one evaluation does not prove


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
    before, rows, ahead = jnp.stack([measured.u, measured.v]), None, measured.ahead
    u, v = before
    if ahead is not None:
        u, v = ahead.led((pieces.axis_u, pieces.axis_v), measured.u, measured.v)
        if measured.poor is None:  # else others rest each time
            ahead = ahead.followed(pieces, u, v, resting)
            rows = ahead.kept.rows
    pulled = pull(problem, pieces, u, v, measured.error, resting, weigh, Arrive(), rows)
    feet, looks, pulls = pulled.feet, pulled.looks, pulled.pulls
    done = resting | (looks > 0)
    looked = jnp.where(resting, 0, jnp.where(done, looks, Arrive.looks)).astype(jnp.int32)
    u, v = jnp.where(resting, before, feet[:2])
    most = Measured(u, v, feet[2], looked, done)
    here, sums, active = _others(method, problem, pieces, measured, most, weigh, pulls.sums, pulled.active)
    if ahead is not None:
        # Of a foot that `method` has found, no one knows which cell it is in.
        ahead = ahead.after(jnp.where(looks > 0, feet[:2] - before, 0.0), pulled.gone | (looks == 0))
        here = eqx.tree_at(lambda m: m.ahead, here, ahead, is_leaf=lambda x: x is None)
    return here, Pulls(sums), active


def _others(
    method: AbstractFootMethod,
    problem: Any,
    pieces: Pieces,
    before: Measured,
    most: Measured,
    weigh: Callable[[Array, Array], Array],
    sums: Array,
    active: Array,
) -> tuple[Measured, Array, Array]:
    """With the feet that have not been found and what they add, some at a time: mostly there are very few.

    They start from where they were: where the pass has taken them need not be downhill.
    """
    points = most.u.shape[0]
    start = Measured(before.u, before.v, before.error, most.steps, before.found)

    def unfinished(carry: tuple[Array, Measured, Array, Array]) -> Array:
        return jnp.any(carry[0])

    def portion(carry: tuple[Array, Measured, Array, Array]) -> tuple[Array, Measured, Array, Array]:
        left, total, sums, active = carry
        number = few_of(left, PORTION)
        at, known = jnp.minimum(number, points - 1), number == points
        some, here = problem.ordered(at), jax.tree.map(lambda x: x[at], start)
        feet = measure_feet(method, some, pieces, here, known, borders=False)
        stay = pull(some, pieces, feet.u, feet.v, feet.error, known, weigh, Stay())
        feet = eqx.tree_at(lambda m: m.steps, feet, feet.steps + here.steps)
        total = jax.tree.map(lambda x, y: x.at[number].set(y, mode="drop"), total, feet)
        left = left.at[number].set(False, mode="drop")
        return left, total, sums + stay.pulls.sums, active + stay.active

    return lax.while_loop(unfinished, portion, (~most.found, most, sums, active))[1:]
