"""From starting parameters to converged feet: the kernel every closest point and every fit calls."""

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._closest._feet import ARRIVED, GIVEN_UP, Feet, Limits, keep, new_feet
from jaxfit._closest._passes import Border, settle
from jaxfit._closest._steps import AbstractFootMethod
from jaxfit._splines._pieces import Pieces

EVERYWHERE, AGAIN = 0, 5  # stages; those between are the four borders


def project(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    tolerance: Array,
    max_steps: Array,
    idle: Bool[Array, " points"] | None = None,
    borders: bool | Bool[Array, ""] = True,
    within: Border | None = None,
) -> Feet:
    """Foot points of `target` on the surface, from the starts (u, v); `idle` points stay where
    they are. With `borders`, which may be traced, feet that do not converge are looked for on the four
    border curves (section 3.1 of the paper). With `within`, bounds of every foot's own, feet are looked for
    nowhere else.

    The coordinates must be small against nothing but their own extent (centre them first): rounding is
    judged by their largest magnitude.
    """
    pieces = jax.tree.map(jnp.asarray, pieces)
    limits = Limits.of(tolerance, jnp.max(jnp.abs(target)), max_steps)
    axes = (pieces.axis_u, pieces.axis_v)
    u, v = (jnp.clip(x, a.breaks[0], a.breaks[-1]) for x, a in zip((u, v), axes, strict=True))
    if within is not None:
        u, v = jnp.clip(u, *within[:2]), jnp.clip(v, *within[2:])
    feet = new_feet(u, v)
    if idle is not None:
        feet = feet.standing(jnp.where(idle, ARRIVED, feet.state))
    if within is not None:
        return settle(method, pieces, target, feet, within, limits)
    if borders is False:
        return settle(method, pieces, target, feet, _border(pieces, jnp.asarray(EVERYWHERE)), limits)
    last = jnp.where(borders, AGAIN, EVERYWHERE)
    return _in_stages(method, pieces, target, feet, limits, last)


def _in_stages(
    method: AbstractFootMethod, pieces: Pieces, target: Array, feet: Feet, limits: Limits, last: Array
) -> Feet:
    """Stages up to the `last`: 0 everywhere; 1-4 one border each, for feet that have not converged; 5
    everywhere again, from the nearest of what was found, so that "converged" always means: with respect to
    the whole surface.
    """

    def unsettled(carry: tuple[Array, Feet]) -> Array:
        number, feet = carry
        return (number <= last) & jnp.any(~feet.converged)

    def stage(carry: tuple[Array, Feet]) -> tuple[Array, Feet]:
        number, old = carry
        border = _border(pieces, number)
        budget = Limits(limits.tolerance, limits.noise, (number + 1) * limits.steps)
        new = settle(method, pieces, target, _begin(old, number, border), border, budget)
        return number + 1, _merge(old, new, number, limits)

    return lax.while_loop(unsettled, stage, (jnp.asarray(EVERYWHERE, jnp.int32), feet))[1]


def _border(pieces: Pieces, number: Array) -> Border:
    """Bounds (low_u, high_u, low_v, high_v) of a stage: the domain, or one of its sides."""
    bounds = []
    for axis, low_side in ((pieces.axis_u, 1), (pieces.axis_v, 3)):
        first, last = axis.breaks[0], axis.breaks[-1]
        bounds.append(jnp.where(number == low_side + 1, last, first))
        bounds.append(jnp.where(number == low_side, first, last))
    return bounds[0], bounds[1], bounds[2], bounds[3]


def _begin(old: Feet, number: Array, border: Border) -> Feet:
    """The feet a stage works on; after the first, those not converged, afresh from their best."""
    low_u, high_u, low_v, high_v = border
    fresh = new_feet(jnp.clip(old.best_u, low_u, high_u), jnp.clip(old.best_v, low_v, high_v))
    fresh = Feet(fresh.real, jnp.stack([fresh.halvings, old.steps, fresh.state]))
    return keep(old.converged | (number == EVERYWHERE), old, fresh)


def _merge(old: Feet, new: Feet, number: Array, limits: Limits) -> Feet:
    """What a stage found; on a border only what is nearer, which has not converged by that."""
    nearer = new.best < old.best - limits.slack(old.best)
    nearer = jnp.where(jnp.isinf(old.best), jnp.isfinite(new.best), nearer)
    whole = (number == EVERYWHERE) | (number == AGAIN)
    state = jnp.where(new.converged & whole, ARRIVED, GIVEN_UP)
    spent = Feet(old.real, new.whole).standing(jnp.full_like(state, GIVEN_UP))
    return keep(old.converged, old, keep(nearer | whole, new.standing(state), spent))
