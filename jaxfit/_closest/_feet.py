"""Foot points on their way: the safeguarded iteration, one evaluation at a time.

A step that increases the distance (beyond rounding) is halved back towards the last accepted foot, so
accepted distances never increase. A bound is active where the gradient points out of it.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._barrier import materialise
from jaxfit._cells import jet_in_line
from jaxfit._closest._box import Box, Sides
from jaxfit._closest._steps import AbstractFootMethod, Forms, measure

MOST_HALVINGS = 40
LONGEST_STEP = 2.0  # in local coordinates: a cell
INSIDE = 1.0 + 1e-6  # in units of a cell's half width: where its polynomial is the surface
# The error foreseen after a step may be this share of the tolerance, for the foot to count as found; so small
# a share because only the order of magnitude is foreseen.
FORESIGHT = 0.01
# After this many evaluations a method that converges linearly gives way to Newton's.
PATIENCE = 30

GOING, ARRIVED, GIVEN_UP = 0, 1, 2


class Feet(eqx.Module):
    """Trial parameters, and the best (last accepted) foot of every point.

    Two stacks of arrays rather than eight arrays: gathering, scattering and choosing then compile once each.
    """

    real: Float[Array, "5 *shape"]
    whole: Int[Array, "3 *shape"]

    @staticmethod
    def of(
        u: Array,
        v: Array,
        best_u: Array,
        best_v: Array,
        best: Array,
        halvings: Array,
        steps: Array,
        state: Array,
    ) -> "Feet":
        """Stack the parts."""
        numbers = [x.astype(jnp.int32) for x in (halvings, steps, state)]
        return Feet(jnp.stack([u, v, best_u, best_v, best]), jnp.stack(numbers))

    @property
    def u(self) -> Float[Array, "*shape"]:
        """Trial parameter, to be evaluated next."""
        return self.real[0]

    @property
    def v(self) -> Float[Array, "*shape"]:
        """Trial parameter."""
        return self.real[1]

    @property
    def best_u(self) -> Float[Array, "*shape"]:
        """Parameter of the last accepted foot."""
        return self.real[2]

    @property
    def best_v(self) -> Float[Array, "*shape"]:
        """Parameter of the last accepted foot."""
        return self.real[3]

    @property
    def best(self) -> Float[Array, "*shape"]:
        """Squared distance of the last accepted foot, infinite before the first evaluation."""
        return self.real[4]

    @property
    def halvings(self) -> Int[Array, "*shape"]:
        """How often the present step has been halved."""
        return self.whole[0]

    @property
    def steps(self) -> Int[Array, "*shape"]:
        """Evaluations so far."""
        return self.whole[1]

    @property
    def state(self) -> Int[Array, "*shape"]:
        """GOING, ARRIVED at a foot to the tolerance, or GIVEN_UP."""
        return self.whole[2]

    def apart(self) -> "Apart":
        """The same, one array each."""
        return Apart(*self.real, *self.whole)

    @property
    def converged(self) -> Bool[Array, "*shape"]:
        """Whether the foot has been found to the tolerance."""
        return self.state == ARRIVED

    def standing(self, state: Int[Array, "*shape"]) -> "Feet":
        """The same feet in another state."""
        return Feet(self.real, jnp.concatenate([self.whole[:2], state[None].astype(jnp.int32)]))


class Apart(NamedTuple):
    """Feet as eight arrays, while they move: computing into a stack is slow, copying into one is not."""

    u: Float[Array, "*shape"]
    v: Float[Array, "*shape"]
    best_u: Float[Array, "*shape"]
    best_v: Float[Array, "*shape"]
    best: Float[Array, "*shape"]
    halvings: Int[Array, "*shape"]
    steps: Int[Array, "*shape"]
    state: Int[Array, "*shape"]


class Limits(eqx.Module):
    """What a foot has to reach, and with how many evaluations.

    `tolerance` is the allowed tangential part of the residual, a length; `noise` the rounding of one.
    """

    tolerance: Float[Array, ""]
    noise: Float[Array, ""]
    steps: Int[Array, ""]

    @staticmethod
    def of(tolerance: Any, reach: Float[Array, ""], steps: Any) -> "Limits":
        """With no tolerance below the rounding of a residual; no coordinate is larger than `reach`."""
        noise = 4.0 * jnp.finfo(reach.dtype).eps * reach
        tolerance = jnp.maximum(jnp.asarray(tolerance, reach.dtype), 4.0 * noise)
        return Limits(tolerance, noise, jnp.asarray(steps, jnp.int32))

    def slack(self, f: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Rounding of a squared distance."""
        return self.noise * (2.0 * jnp.sqrt(f) + self.noise)


def new_feet(u: Float[Array, "*shape"], v: Float[Array, "*shape"]) -> Feet:
    """Feet that have not been evaluated yet."""
    zero = jnp.zeros(u.shape, jnp.int32)
    return Feet.of(u, v, u, v, jnp.full_like(u, jnp.inf), zero, zero, zero)


def is_going(feet: Feet | Apart, limits: Limits) -> Bool[Array, "*shape"]:
    """Which feet are to be moved on."""
    return (feet.state == GOING) & (feet.steps < limits.steps)


def advance(
    method: AbstractFootMethod,
    feet: Apart,
    target: Float[Array, "d slots"],
    coefficients: Float[Array, "d K L rows"],
    box: Box,
    limits: Limits,
) -> Apart:
    """Evaluate every trial, accept or halve it, and propose the next one.

    All but the coefficients is given for each slot, the slots of all rows in one line.

    A trial outside the cell whose polynomial is at hand waits until it is laid out with its own.
    """
    always = limits.tolerance < jnp.inf
    u, v, best_u, best_v, best, halvings, steps, _ = feet
    first = _measure_at(method, always, u, v, target, coefficients, box)
    next_u, next_v, after, foreseen = _next_trial(method, first, u, v, best, steps > PATIENCE, box, limits)
    # Not a number counts as inside, and so does what only rounding puts outside: nothing waits for ever.
    rounding, sides = 8.0 * float(jnp.finfo(u.dtype).eps), box.apart()
    off_u = (jnp.abs(u - sides.centre_u) - rounding * jnp.abs(u)) * sides.rate_u
    off_v = (jnp.abs(v - sides.centre_v) - rounding * jnp.abs(v)) * sides.rate_v
    judged = is_going(feet, limits) & ~(jnp.maximum(off_u, off_v) > INSIDE)
    accepted = first.f <= best + limits.slack(first.f)
    still = (next_u == u) & (next_v == v)
    # What is foreseen rests on the last two steps, so the last one must be whole.
    certain = still | (foreseen & (halvings == 0) & method.quadratic)
    back_u, back_v = 0.5 * (u + best_u), 0.5 * (v + best_v)
    spent = (halvings >= MOST_HALVINGS) | ((back_u == best_u) & (back_v == best_v))
    taken = judged & accepted
    returns = judged & ~accepted
    leaps = taken & certain
    here_u, here_v, here = (jnp.where(leaps, x, y) for x, y in ((next_u, u), (next_v, v), (after, first.f)))
    counted = jnp.where(taken, 0, jnp.where(returns, halvings + 1, halvings))
    state = jnp.where(leaps, ARRIVED, jnp.where(returns & spent, GIVEN_UP, feet.state))
    return Apart(
        jnp.where(taken, next_u, jnp.where(returns, back_u, u)),
        jnp.where(taken, next_v, jnp.where(returns, back_v, v)),
        jnp.where(taken, here_u, best_u),
        jnp.where(taken, here_v, best_v),
        jnp.where(taken, here, best),
        counted.astype(jnp.int32),
        (steps + judged).astype(jnp.int32),
        state.astype(jnp.int32),
    )


def _measure_at(
    method: AbstractFootMethod,
    always: Array,
    u: Array,
    v: Array,
    target: Array,
    coefficients: Array,
    box: Box,
) -> Forms:
    """The inner products at the trials."""
    s, t = box.apart().local(u, v)
    jet = jet_in_line(always, coefficients, s, t)
    return materialise(
        always, lambda target, jet: measure(target - jet.value, jet, method.drift), target, jet
    )


def _next_trial(
    method: AbstractFootMethod,
    first: Forms,
    u: Array,
    v: Array,
    best: Array,
    late: Array,
    box: Box,
    limits: Limits,
) -> tuple[Array, Array, Array, Array]:
    """Take a step: the next parameters, the squared distance there to third order, and whether the foot is
    foreseen to be found there.

    A foot that has settled, or is held at its bounds, gets its own parameters back.
    """
    always = limits.tolerance < jnp.inf
    pinned_s, pinned_t, settled = pins(first, u, v, box.apart(), limits.tolerance)
    ds, dt = method.step(first, pinned_s, pinned_t, late, always)
    ds, dt = materialise(always, _downhill, first, u, v, ds, dt, pinned_s, pinned_t, settled, box)
    return materialise(always, _foresee, first, u, v, ds, dt, best, box, limits)


def _foresee(
    first: Forms, u: Array, v: Array, ds: Array, dt: Array, best: Array, box: Box, limits: Limits
) -> tuple[Array, Array, Array, Array]:
    sides = box.apart()
    next_u = landing(u, ds, sides.low_u, sides.high_u, sides.half_u, sides.rate_u)
    next_v = landing(v, dt, sides.low_v, sides.high_v, sides.half_v, sides.rate_v)
    # |step|^2 in the metric of the Hessian is half the fall of f to come, and was half its last fall.
    fall = first.gradient_s * ds + first.gradient_t * dt
    before = jnp.where(best < jnp.inf, best - first.f, 0.0)
    # Quadratic convergence: steps of length a, then b, are followed by one of b (b / a^2) b. A residual is
    # longer than its step where the Hessian is larger than the first form.
    a, b, c = first.E - first.e_ss, first.F - first.e_st, first.G - first.e_tt
    share = (FORESIGHT * limits.tolerance * before) ** 2
    foreseen = (fall**3 * a <= share * first.E) & (fall**3 * c <= share * first.G)
    foreseen &= (before > 0) & (fall >= 0) & (a > 0) & (a * c > b * b)
    # The distance is foreseen as well as the foot where it is longer than the step.
    foreseen &= fall <= first.f - fall
    # On a bound or in another cell it is not the same polynomial that decides.
    foreseen &= (
        (next_u > sides.low_u) & (next_u < sides.high_u) & (next_v > sides.low_v) & (next_v < sides.high_v)
    )
    at_s, at_t = sides.local(next_u, next_v)
    foreseen &= (jnp.abs(at_s) <= INSIDE) & (jnp.abs(at_t) <= INSIDE)
    return next_u, next_v, jnp.maximum(first.f - fall, 0.0), foreseen


def landing(u: Array, ds: Array, low: Array, high: Array, half: Array, rate: Array) -> Array:
    """Where a step ends; one cut off at a bound ends on the bound to the last bit."""
    free = jnp.clip(u + ds * half, low, high)
    return jnp.where(ds <= (low - u) * rate, low, jnp.where(ds >= (high - u) * rate, high, free))


def _downhill(
    first: Forms,
    u: Array,
    v: Array,
    ds: Array,
    dt: Array,
    pinned_s: Array,
    pinned_t: Array,
    settled: Array,
    box: Box,
) -> tuple[Array, Array]:
    """The step, no coordinate longer than LONGEST_STEP, or half the scaled gradient where it leads uphill.

    Cut off at a bound, a coupled step may do so; the scaled gradient never does.
    """
    ds, dt = jnp.clip(ds, -LONGEST_STEP, LONGEST_STEP), jnp.clip(dt, -LONGEST_STEP, LONGEST_STEP)
    sides = box.apart()
    ds, dt = within(sides, u, v, ds, dt)
    uphill = first.gradient_s * ds + first.gradient_t * dt <= 0
    tiny = jnp.finfo(u.dtype).tiny
    slope_s = jnp.where(pinned_s, 0.0, 0.5 * first.gradient_s / jnp.maximum(first.E, tiny))
    slope_t = jnp.where(pinned_t, 0.0, 0.5 * first.gradient_t / jnp.maximum(first.G, tiny))
    slope_s, slope_t = within(sides, u, v, slope_s, slope_t)
    ds, dt = jnp.where(uphill, slope_s, ds), jnp.where(uphill, slope_t, dt)
    return jnp.where(settled, 0.0, ds), jnp.where(settled, 0.0, dt)


def within(box: Sides, u: Array, v: Array, ds: Array, dt: Array) -> tuple[Array, Array]:
    """A step in local coordinates, cut off at the bounds."""
    low_s, high_s = (box.low_u - u) * box.rate_u, (box.high_u - u) * box.rate_u
    low_t, high_t = (box.low_v - v) * box.rate_v, (box.high_v - v) * box.rate_v
    return jnp.clip(ds, low_s, high_s), jnp.clip(dt, low_t, high_t)


def pins(first: Forms, u: Array, v: Array, box: Sides, tolerance: Array) -> tuple[Array, Array, Array]:
    """Which coordinates are held at a bound by the gradient, and whether the free ones are settled.

    Settled: the residual's components along the free tangents, lengths, are below the tolerance.
    """
    gs, gt = first.gradient_s, first.gradient_t
    short = tolerance**2  # moving along so short a tangent changes nothing: curves along v, poles
    pinned_s = (box.high_u <= box.low_u) | (short >= first.E)
    pinned_t = (box.high_v <= box.low_v) | (short >= first.G)
    pinned_s |= jnp.where(gs < 0, u <= box.low_u, u >= box.high_u)
    pinned_t |= jnp.where(gt < 0, v <= box.low_v, v >= box.high_v)
    settled_s = pinned_s | (gs * gs <= tolerance**2 * first.E)
    settled_t = pinned_t | (gt * gt <= tolerance**2 * first.G)
    return pinned_s, pinned_t, settled_s & settled_t


def keep(which: Bool[Array, "*shape"], old: Feet, new: Feet) -> Feet:
    """`old` where `which`, `new` elsewhere."""
    return Feet(jnp.where(which[None], old.real, new.real), jnp.where(which[None], old.whole, new.whole))
