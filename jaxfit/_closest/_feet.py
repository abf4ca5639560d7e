"""Foot points on their way: the safeguarded iteration, one evaluation at a time.

A step that increases the distance (beyond rounding) is halved back towards the last accepted foot, so
accepted distances never increase. A bound is active where the gradient points out of it.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._cells import evaluate_jet, staged
from jaxfit._closest._steps import AbstractFootMethod, Forms, measure

MOST_HALVINGS = 40
LONGEST_STEP = 4.0  # in local coordinates: two cells


class Feet(eqx.Module):
    """Trial parameters, and the best (last accepted) foot of every point.

    Two stacks of arrays rather than nine arrays: gathering, scattering and choosing then compile once each.
    """

    real: Float[Array, "5 *shape"]
    whole: Int[Array, "4 *shape"]

    @staticmethod
    def of(
        u: Array,
        v: Array,
        best_u: Array,
        best_v: Array,
        best: Array,
        halvings: Array,
        steps: Array,
        done: Array,
        converged: Array,
    ) -> "Feet":
        """Stack the parts."""
        numbers = [x.astype(jnp.int32) for x in (halvings, steps, done, converged)]
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
    def done(self) -> Bool[Array, "*shape"]:
        """Whether nothing more is to be tried."""
        return self.whole[2] > 0

    @property
    def converged(self) -> Bool[Array, "*shape"]:
        """Whether the foot has been found to the tolerance."""
        return self.whole[3] > 0

    def marked(self, done: Array, converged: Array) -> "Feet":
        """The same feet with other flags."""
        flags = jnp.stack([done.astype(jnp.int32), converged.astype(jnp.int32)])
        return Feet(self.real, jnp.concatenate([self.whole[:2], flags]))


class Box(eqx.Module):
    """Bounds on the parameters, and the local coordinates of the cell the feet are in."""

    low_u: Array
    high_u: Array
    low_v: Array
    high_v: Array
    centre_u: Array
    half_u: Array
    centre_v: Array
    half_v: Array


def new_feet(u: Float[Array, "..."], v: Float[Array, "..."]) -> Feet:
    """Feet that have not been evaluated yet."""
    zero = jnp.zeros(u.shape, jnp.int32)
    no = jnp.zeros(u.shape, bool)
    return Feet.of(u, v, u, v, jnp.full_like(u, jnp.inf), zero, zero, no, no)


def advance(
    method: AbstractFootMethod,
    feet: Feet,
    target: list[Array],
    coefficients: Array,
    box: Box,
    tolerance: Array,
    noise: Array,
) -> Feet:
    """Evaluate every trial, accept or halve it, and propose the next one.

    `tolerance` is the allowed tangential part of the residual, a length; `noise` the rounding of one.
    Feet that are done stay as they are.
    """
    always = tolerance < jnp.inf
    first = staged(always, measure_at(method), feet.u, feet.v, target, coefficients, box)
    f = first.f
    next_u, next_v = staged(always, next_trial(method, True), first, feet.u, feet.v, box, tolerance)
    accepted = f <= feet.best + noise * (2.0 * jnp.sqrt(f) + noise)
    still = (next_u == feet.u) & (next_v == feet.v)
    back_u, back_v = 0.5 * (feet.u + feet.best_u), 0.5 * (feet.v + feet.best_v)
    spent = (feet.halvings >= MOST_HALVINGS) | ((back_u == feet.best_u) & (back_v == feet.best_v))
    arrived = accepted & still
    done = arrived | (~accepted & spent)
    best_u = jnp.where(accepted, feet.u, feet.best_u)
    best_v = jnp.where(accepted, feet.v, feet.best_v)
    moved = Feet.of(
        u=jnp.where(done, best_u, jnp.where(accepted, next_u, back_u)),
        v=jnp.where(done, best_v, jnp.where(accepted, next_v, back_v)),
        best_u=best_u,
        best_v=best_v,
        best=jnp.where(accepted, f, feet.best),
        halvings=jnp.where(accepted, 0, feet.halvings + 1),
        steps=feet.steps + 1,
        done=done,
        converged=arrived,
    )
    return keep(feet.done, feet, moved)


def measure_at(method: AbstractFootMethod) -> Callable[..., Forms]:
    """The function of parameters, targets, coefficients and box that gives the inner products there."""

    def at(u: Array, v: Array, target: list[Array], coefficients: Array, box: Box) -> Forms:
        s = (u - box.centre_u) / box.half_u
        t = (v - box.centre_v) / box.half_v
        jet = evaluate_jet(coefficients, s, t)
        e = [q - x for q, x in zip(target, jet.value, strict=True)]
        return measure(e, jet, method.drift)

    return at


def next_trial(method: AbstractFootMethod, careful: bool) -> Callable[..., tuple[Array, Array]]:
    """The function of inner products and parameters that takes a step.

    A foot that has settled, or is held at its bounds, gets its own parameters back. `careful` limits the
    step's length and sees to it that it leads downhill.
    """

    def after(first: Forms, u: Array, v: Array, box: Box, tolerance: Array) -> tuple[Array, Array]:
        pinned_s, pinned_t, settled = _pins(first, u, v, box, tolerance)
        ds, dt = method.step(first, pinned_s, pinned_t)
        if careful:
            ds, dt = _downhill(first, u, v, ds, dt, pinned_s, pinned_t, box)
        next_u = jnp.clip(u + jnp.where(settled, 0.0, ds * box.half_u), box.low_u, box.high_u)
        next_v = jnp.clip(v + jnp.where(settled, 0.0, dt * box.half_v), box.low_v, box.high_v)
        return next_u, next_v

    return after


def _downhill(
    first: Forms,
    u: Array,
    v: Array,
    ds: Array,
    dt: Array,
    pinned_s: Array,
    pinned_t: Array,
    box: Box,
) -> tuple[Array, Array]:
    """The step, no longer than LONGEST_STEP, or half the scaled gradient where it leads uphill.

    Cut off at a bound, a coupled step may do so; the scaled gradient never does.
    """
    tiny = jnp.finfo(u.dtype).tiny
    longest = jnp.maximum(jnp.abs(ds), jnp.abs(dt))
    shorter = jnp.minimum(1.0, LONGEST_STEP / jnp.maximum(longest, 1.0))
    ds, dt = _within(box, u, v, shorter * ds, shorter * dt)
    uphill = first.gradient_s * ds + first.gradient_t * dt <= 0
    slope_s = jnp.where(pinned_s, 0.0, 0.5 * first.gradient_s / jnp.maximum(first.E, tiny))
    slope_t = jnp.where(pinned_t, 0.0, 0.5 * first.gradient_t / jnp.maximum(first.G, tiny))
    slope_s, slope_t = _within(box, u, v, slope_s, slope_t)
    return jnp.where(uphill, slope_s, ds), jnp.where(uphill, slope_t, dt)


def _within(box: Box, u: Array, v: Array, ds: Array, dt: Array) -> tuple[Array, Array]:
    """A step in local coordinates, cut off at the bounds."""
    low_s, high_s = (box.low_u - u) / box.half_u, (box.high_u - u) / box.half_u
    low_t, high_t = (box.low_v - v) / box.half_v, (box.high_v - v) / box.half_v
    return jnp.clip(ds, low_s, high_s), jnp.clip(dt, low_t, high_t)


def _pins(first: Forms, u: Array, v: Array, box: Box, tolerance: Array) -> tuple[Array, Array, Array]:
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


def keep(which: Array, old: Feet, new: Feet) -> Feet:
    """`old` where `which`, `new` elsewhere."""
    return Feet(jnp.where(which[None], old.real, new.real), jnp.where(which[None], old.whole, new.whole))
