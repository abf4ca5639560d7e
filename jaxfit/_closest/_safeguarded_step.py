"""One safeguarded step of moving feet: evaluate, accept or halve, propose the next.

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
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._foot_states import FOUND, GIVEN_UP, GOING, FootLimits
from jaxfit._closest._forms import Expansion, Forms, both, either, expand, inner_products, total
from jaxfit._closest._taylor_projection import INSIDE, Prediction, certified_step, linearised_step

LONGEST_STEP = 2.0  # in local coordinates: a cell
# After this many evaluations a method that converges linearly is replaced by Newton's.
MOST_LINEAR_STEPS = 30


class MovingFeet(NamedTuple):
    """`FootStates` of the slots of a block, one array for each part, and the residuals at the best ones."""

    trial: Float[Array, "2 1 slots"]
    best: Float[Array, "2 1 slots"]
    f: Float[Array, "1 1 slots"]
    steps: Float[Array, "1 1 slots"]
    state: Float[Array, "1 1 slots"]
    e: Float[Array, "1 d slots"] | None


class Mode(NamedTuple):
    """Whether all feet of a pass end after one evaluation (`single`), and do so without a step (`fixed`)."""

    single: Bool[Array, ""]
    fixed: Bool[Array, ""]


def advance(
    method: AbstractFootMethod,
    feet: MovingFeet,
    target: Float[Array, "1 d slots"],
    coefficients: Float[Array, "rows d K L"],
    bounds: Bounds,
    third: Float[Array, "1 1 slots"],
    limits: FootLimits,
    creased: bool,
    mode: Mode | None,
) -> MovingFeet:
    """Evaluate every trial, accept or halve it, and propose the next one.

    A trial outside the cell of its row waits for the next pass, which has the right polynomial.
    """
    always = limits.tolerance < jnp.inf
    x, fall_back = feet.trial, feet.steps > MOST_LINEAR_STEPS
    at = expand(always, coefficients, bounds.local(x), target)
    forms = materialise(always, lambda at: inner_products(at, method.needs_christoffel), at)

    # Each value is stored, or XLA would compute it again for each of its uses.
    tolerance = limits.tolerance
    active, converged = materialise(
        always, lambda forms, x: active_bounds(forms, x, bounds, tolerance), forms, x
    )
    step = materialise(always, lambda forms, p: method.step(forms, p, fall_back), forms, active)
    step = materialise(always, partial(_descent_step, bounds), forms, x, step, active, converged)
    end = materialise(always, lambda x, step: bounds.end_of_step(x, step), x, step)
    prediction = _predict(method, always, at, forms, x, active, step, end, bounds, third, limits, mode)
    single = False if mode is None else mode.single
    certain = prediction.certain & ~either(active) if creased else prediction.certain
    if creased and mode is not None:  # a foot at a crease may have to go on across it
        certain |= single

    def accept(feet: MovingFeet, f: Array) -> tuple[Array, Array]:
        # NaN counts as inside, and so does a trial that is outside by rounding: no foot waits for ever.
        rounding = 8.0 * float(jnp.finfo(f.dtype).eps)
        off = jnp.abs(bounds.local(feet.trial)) - rounding * jnp.abs(feet.trial) * bounds.rate
        evaluated = (feet.state == GOING) & ((feet.steps < limits.steps) | single) & both(~(off > INSIDE))
        return evaluated, evaluated & (f <= feet.f + limits.rounding_of(f))

    evaluated, accepted = materialise(always, accept, feet, forms.f)

    def choose(
        feet: MovingFeet,
        evaluated: Array,
        accepted: Array,
        f: Array,
        e: Array,
        prediction: Prediction,
        end: Array,
    ) -> MovingFeet:
        x, best, best_f, steps, state, best_e = feet
        rejected, accepts_prediction = evaluated & ~accepted, accepted & prediction.certain
        back = 0.5 * (x + best)
        next_x = _choose(accepted, prediction.end, _choose(rejected, back, x))
        here = _choose(accepts_prediction, prediction.end, _choose(accepted, x, best))
        here_f = lax.select(accepts_prediction, prediction.f, lax.select(accepted, f, best_f))
        given_up = rejected & (both(back == best) | single)
        found = accepts_prediction | (accepted & both(end == x))
        state = jnp.where(found, float(FOUND), jnp.where(given_up, float(GIVEN_UP), state))
        if best_e is not None:
            best_e = _choose(accepts_prediction, prediction.e, _choose(accepted, e, best_e))
        return MovingFeet(next_x, here, here_f, steps + evaluated, state, best_e)

    prediction = prediction._replace(certain=certain)
    return materialise(always, choose, feet, evaluated, accepted, forms.f, at.e, prediction, end)


def _predict(
    method: AbstractFootMethod,
    always: Array,
    at: Expansion,
    forms: Forms,
    x: Array,
    active: Array,
    step: Array,
    end: Array,
    bounds: Bounds,
    third: Array,
    limits: FootLimits,
    mode: Mode | None,
) -> Prediction:
    """The next trial, and whether it is final: certified, or the only step of a `single` pass."""

    def certified() -> Prediction:
        found, good = certified_step(always, at, forms, x, active, bounds, third, limits.tolerance)
        good = good if method.converges_quadratically else jnp.zeros_like(good)
        return found._replace(end=_choose(found.certain | good, found.end, end))

    if mode is None:
        return certified()

    def linearised() -> Prediction:
        return linearised_step(at, forms, x, jnp.where(mode.fixed, 0.0, step), bounds)

    return lax.cond(mode.single, linearised, certified)


def _choose(which: Array, x: Array, y: Array) -> Array:
    return lax.select(jnp.broadcast_to(which, x.shape), x, y)


def _descent_step(
    bounds: Bounds, forms: Forms, x: Array, step: Array, active: Array, converged: Array
) -> Float[Array, "2 1 slots"]:
    """The step, no coordinate longer than LONGEST_STEP, or half the scaled gradient where it leads uphill.

    Cut off at a bound, a coupled step may do so; the scaled gradient never does.
    """
    longest = np.asarray(LONGEST_STEP, step.dtype)
    step = bounds.clip_step(x, lax.clamp(-longest, step, longest))
    uphill = total(forms.gradient * step) <= 0
    slope = 0.5 * forms.gradient / jnp.maximum(forms.metric, jnp.finfo(x.dtype).tiny)
    slope = bounds.clip_step(x, jnp.where(active, 0.0, slope))
    return jnp.where(converged, 0.0, _choose(uphill, slope, step))
