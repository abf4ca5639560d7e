"""One evaluation of feet on their way, and the step from there.

A step that increases the distance (beyond rounding) is halved back towards the last accepted foot, so
accepted distances never increase. A bound is active where the gradient points out of it.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

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

    trial: Float[Array, "2 slots"]
    best: Float[Array, "2 slots"]
    f: Float[Array, "1 slots"]
    steps: Int[Array, "1 slots"]
    state: Int[Array, "1 slots"]
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
    third: Float[Array, "1 slots"],
    limits: Limits,
    creased: bool,
    mode: Mode | None,
) -> MovingFeet:
    """Evaluate every trial, accept or halve it, and propose the next one.

    A trial outside the cell whose polynomial is at hand waits for a pass that has its own. With a `mode`
    every foot can be done after one step.
    """
    always = limits.tolerance < jnp.inf
    x, best, best_f, steps, state, best_e = feet
    local = bounds.local(x)
    at = expand(always, coefficients, local, target)
    forms = materialise(always, lambda at: inner_products(at, method.drift), at)
    late = steps > PATIENCE

    def propose(forms: Forms, x: Array) -> tuple[Array, Array, Array]:
        pinned, settled = active_bounds(forms, x, bounds, limits.tolerance)
        step = _downhill(forms, x, method.step(forms, pinned, late), pinned, settled, bounds)
        return pinned, step, bounds.end_of_step(x, step)

    pinned, step, end = materialise(always, propose, forms, x)
    ahead = _predict(method, always, at, forms, x, pinned, step, end, bounds, third, limits, mode)
    single = False if mode is None else mode.single
    # Not a number counts as inside, and so does what only rounding puts outside: nothing waits for ever.
    rounding = 8.0 * float(jnp.finfo(x.dtype).eps)
    off = jnp.abs(local) - rounding * jnp.abs(x) * bounds.rate
    judged = (state == GOING) & ((steps < limits.steps) | single) & both(~(off > INSIDE))
    accepted = forms.f <= best_f + limits.slack(forms.f)
    certain = ahead.certain & ~either(pinned) if creased else ahead.certain
    if creased and mode is not None:  # what is held at a crease may have to go on behind it
        certain |= single
    found = certain | both(end == x)
    taken, returns = judged & accepted, judged & ~accepted
    back = 0.5 * (x + best)
    spent = both(back == best) | single
    next_x = _choose(taken, ahead.end, _choose(returns, back, x))
    leaps = taken & certain
    here = _choose(leaps, ahead.end, _choose(taken, x, best))
    here_f = lax.select(leaps, ahead.f, lax.select(taken, forms.f, best_f))
    state = jnp.where(taken & found, FOUND, jnp.where(returns & spent, GIVEN_UP, state))
    if best_e is not None:
        best_e = _choose(leaps[:, None], ahead.e, _choose(taken[:, None], at.e, best_e))
    return MovingFeet(next_x, here, here_f, steps + judged, state, best_e)


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
    forms: Forms, x: Array, step: Array, pinned: Array, settled: Array, bounds: Bounds
) -> Float[Array, "2 slots"]:
    """The step, no coordinate longer than LONGEST_STEP, or half the scaled gradient where it leads uphill.

    Cut off at a bound, a coupled step may do so; the scaled gradient never does.
    """
    step = bounds.clip_step(x, lax.clamp(-LONGEST_STEP, step, LONGEST_STEP))
    uphill = total(forms.gradient * step) <= 0
    slope = 0.5 * forms.gradient / jnp.maximum(forms.metric, jnp.finfo(x.dtype).tiny)
    slope = bounds.clip_step(x, jnp.where(pinned, 0.0, slope))
    return jnp.where(settled, 0.0, _choose(uphill, slope, step))
