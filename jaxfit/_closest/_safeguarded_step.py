"""One evaluation of feet on their way, and the step from there.

A step that increases the distance (beyond rounding) is halved back towards the last accepted foot, so
accepted distances never increase. A bound is active where the gradient points out of it.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._closest._bounds import Bounds, active_bounds
from jaxfit._closest._feet import FOUND, GIVEN_UP, GOING, Limits
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._forms import Expansion, Forms, both, either, expand, inner_products, total
from jaxfit._closest._taylor_projection import INSIDE, Prediction, certified_step, linearised_step

LONGEST_STEP = 2.0  # in local coordinates: a cell
# After this many evaluations a method that converges linearly gives way to Newton's.
PATIENCE = 30


class MovingFeet(NamedTuple):
    """`Feet` of the slots of a block, one array for each part, and the residuals at the best ones."""

    trial: Float[Array, "2 1 slots"]
    best: Float[Array, "2 1 slots"]
    f: Float[Array, "1 1 slots"]
    steps: Float[Array, "1 1 slots"]
    state: Float[Array, "1 1 slots"]
    e: Float[Array, "1 d slots"] | None


class Mode(NamedTuple):
    """How every foot of a pass is done after one evaluation: by one step, or where it is (`fixed`).

    None of both where `single` is false.
    """

    single: Bool[Array, ""]
    fixed: Bool[Array, ""]


def advance(
    method: AbstractFootMethod,
    feet: MovingFeet,
    target: Float[Array, "1 d slots"],
    coefficients: Float[Array, "rows d K L"],
    bounds: Bounds,
    third: Float[Array, "1 1 slots"],
    limits: Limits,
    creased: bool,
    mode: Mode | None,
) -> MovingFeet:
    """Evaluate every trial, accept or halve it, and propose the next one.

    A trial outside the cell whose polynomial is at hand waits for a pass that has its own. With a `mode`
    every foot can be done after one step.
    """
    always = limits.tolerance < jnp.inf
    x, late = feet.trial, feet.steps > PATIENCE
    at = expand(always, coefficients, bounds.local(x), target)
    forms = materialise(always, lambda at: inner_products(at, method.drift), at)

    # Walls in between, or what follows would compute the same once for each of its results.
    tolerance = limits.tolerance
    pinned, settled = materialise(
        always, lambda forms, x: active_bounds(forms, x, bounds, tolerance), forms, x
    )
    step = materialise(always, lambda forms, p: method.step(forms, p, late), forms, pinned)
    step = materialise(always, partial(_downhill, bounds), forms, x, step, pinned, settled)
    end = materialise(always, lambda x, step: bounds.end_of_step(x, step), x, step)
    ahead = _predict(method, always, at, forms, x, pinned, step, end, bounds, third, limits, mode)
    single = False if mode is None else mode.single
    certain = ahead.certain & ~either(pinned) if creased else ahead.certain
    if creased and mode is not None:  # what is held at a crease may have to go on behind it
        certain |= single

    def judge(feet: MovingFeet, f: Array) -> tuple[Array, Array]:
        # Not a number counts as inside, and so does what only rounding puts outside: nothing waits for ever.
        rounding = 8.0 * float(jnp.finfo(f.dtype).eps)
        off = jnp.abs(bounds.local(feet.trial)) - rounding * jnp.abs(feet.trial) * bounds.rate
        judged = (feet.state == GOING) & ((feet.steps < limits.steps) | single) & both(~(off > INSIDE))
        return judged, judged & (f <= feet.f + limits.slack(f))

    judged, taken = materialise(always, judge, feet, forms.f)

    def choose(
        feet: MovingFeet, judged: Array, taken: Array, f: Array, e: Array, ahead: Prediction, end: Array
    ) -> MovingFeet:
        x, best, best_f, steps, state, best_e = feet
        returns, leaps, back = judged & ~taken, taken & ahead.certain, 0.5 * (x + best)
        next_x = _choose(taken, ahead.end, _choose(returns, back, x))
        here = _choose(leaps, ahead.end, _choose(taken, x, best))
        here_f = lax.select(leaps, ahead.f, lax.select(taken, f, best_f))
        gone = returns & (both(back == best) | single)
        found = leaps | (taken & both(end == x))
        state = jnp.where(found, float(FOUND), jnp.where(gone, float(GIVEN_UP), state))
        if best_e is not None:
            best_e = _choose(leaps, ahead.e, _choose(taken, e, best_e))
        return MovingFeet(next_x, here, here_f, steps + judged, state, best_e)

    ahead = ahead._replace(certain=certain)
    return materialise(always, choose, feet, judged, taken, forms.f, at.e, ahead, end)


def _predict(
    method: AbstractFootMethod,
    always: Array,
    at: Expansion,
    forms: Forms,
    x: Array,
    pinned: Array,
    step: Array,
    end: Array,
    bounds: Bounds,
    third: Array,
    limits: Limits,
    mode: Mode | None,
) -> Prediction:
    """Where to go next, and whether the foot is there: certainly, or because one step is all."""

    def certified() -> Prediction:
        found, good = certified_step(always, at, forms, x, pinned, bounds, third, limits.tolerance)
        good = good if method.quadratic else jnp.zeros_like(good)
        return found._replace(end=_choose(found.certain | good, found.end, end))

    if mode is None:
        return certified()

    def linearised() -> Prediction:
        return linearised_step(at, forms, x, jnp.where(mode.fixed, 0.0, step), bounds)

    return lax.cond(mode.single, linearised, certified)


def _choose(which: Array, x: Array, y: Array) -> Array:
    return lax.select(jnp.broadcast_to(which, x.shape), x, y)


def _downhill(
    bounds: Bounds, forms: Forms, x: Array, step: Array, pinned: Array, settled: Array
) -> Float[Array, "2 1 slots"]:
    """The step, no coordinate longer than LONGEST_STEP, or half the scaled gradient where it leads uphill.

    Cut off at a bound, a coupled step may do so; the scaled gradient never does.
    """
    longest = np.asarray(LONGEST_STEP, step.dtype)
    step = bounds.clip_step(x, lax.clamp(-longest, step, longest))
    uphill = total(forms.gradient * step) <= 0
    slope = 0.5 * forms.gradient / jnp.maximum(forms.metric, jnp.finfo(x.dtype).tiny)
    slope = bounds.clip_step(x, jnp.where(pinned, 0.0, slope))
    return jnp.where(settled, 0.0, _choose(uphill, slope, step))
