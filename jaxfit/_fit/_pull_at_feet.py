"""How error vectors pull, with feet converged."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Int

from jaxfit._cells import few_of
from jaxfit._closest import AbstractFootMethod
from jaxfit._fit._foot_moves import Arrive, Stay
from jaxfit._fit._loop import Measured
from jaxfit._fit._measure import measure_feet
from jaxfit._fit._pull import Pulls, pull
from jaxfit._splines._pieces import Pieces


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
    before, rows, kept = jnp.stack([measured.u, measured.v]), None, None
    u, v = before
    if measured.ahead is not None:
        kept = measured.ahead.kept
        u, v = measured.ahead.led((pieces.axis_u, pieces.axis_v), measured.u, measured.v)
    if kept is not None and measured.poor is None:  # else others rest each time
        # Whoever was found at the first look was in its row's cell.
        kept = kept.followed(pieces, u, v, resting, measured.steps != 1)
        rows = kept.rows
    feet, looks, pulls, active = pull(problem, pieces, u, v, measured.error, resting, weigh, Arrive(), rows)
    done = resting | (looks > 0)
    looked = jnp.where(resting, 0, jnp.where(done, looks, Arrive.looks)).astype(jnp.int32)
    u, v = jnp.where(resting, before, feet[:2])
    most = Measured(u, v, feet[2], looked, done)
    here, sums, active = _others(method, problem, pieces, measured, most, weigh, pulls.sums, active)
    if measured.ahead is not None and kept is not None:
        ahead = measured.ahead.after(jnp.where(looks > 0, feet[:2] - before, 0.0), kept)
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
    """With the feet that have not been found and what they add, as many at a time as `few_of` gives: mostly
    there are very few.

    They start from where they were: where the pass has taken them need not be downhill.
    """
    points = most.u.shape[0]
    start = Measured(before.u, before.v, before.error, most.steps, before.found)

    def unfinished(carry: tuple[Array, Measured, Array, Array]) -> Array:
        return jnp.any(carry[0])

    def portion(carry: tuple[Array, Measured, Array, Array]) -> tuple[Array, Measured, Array, Array]:
        left, total, sums, active = carry
        number = few_of(left)
        at, known = jnp.minimum(number, points - 1), number == points
        some, here = problem.ordered(at), jax.tree.map(lambda x: x[at], start)
        feet = measure_feet(method, some, pieces, here, known, borders=False)
        stay = pull(some, pieces, feet.u, feet.v, feet.error, known, weigh, Stay())
        feet = eqx.tree_at(lambda m: m.steps, feet, feet.steps + here.steps)
        total = jax.tree.map(lambda x, y: x.at[number].set(y, mode="drop"), total, feet)
        return left.at[number].set(False, mode="drop"), total, sums + stay[2].sums, active + stay[3]

    return lax.while_loop(unfinished, portion, (~most.found, most, sums, active))[1:]
