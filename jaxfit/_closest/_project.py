"""Point projection: converged feet from starting parameters.

Feet that do not converge are searched again on the four border curves (section 3.1 of the paper).
"""

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._foot_states import FOUND, GIVEN_UP, GOING, FootLimits, FootStates, select_feet
from jaxfit._closest._iterate_feet import iterate_feet
from jaxfit._splines._pieces import Pieces

WHOLE_DOMAIN, WHOLE_AGAIN = 0, 5  # numbers of stages; 1 to 4 are the four borders

ParameterBounds = tuple[Array, Array, Array, Array]  # low_u, high_u, low_v, high_v: of all points, or of each


def in_precision_of(target: Array, pieces: Pieces) -> Pieces:
    """The pieces as arrays of the target's floating type; knots may come with another."""
    arrays = jax.tree.map(jnp.asarray, pieces)
    return jax.tree.map(
        lambda x: x.astype(target.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, arrays
    )


def initial_feet(
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    idle: Bool[Array, " points"] | None,
    within: ParameterBounds | None,
    done: int,
) -> tuple[FootStates, Float[Array, "2 2 _"] | None]:
    """Feet at the nearest places to (u, v) in the domain, and their bounds; `idle` ones are `done`."""
    low_u, high_u, low_v, high_v = _domain(pieces) if within is None else within
    dtype = pieces.coefficients.dtype
    u, v = (jnp.clip(*x).astype(dtype) for x in ((u, low_u, high_u), (v, low_v, high_v)))
    feet = FootStates.begin(u, v, state=GOING if idle is None else jnp.where(idle, done, GOING))
    return feet, None if within is None else _as_bounds(within).astype(dtype)


def _domain(pieces: Pieces) -> ParameterBounds:
    dtype = pieces.coefficients.dtype  # knots may be more precise
    along_u, along_v = (a.breaks.astype(dtype) for a in (pieces.axis_u, pieces.axis_v))
    return along_u[0], along_u[-1], along_v[0], along_v[-1]


def _as_bounds(border: ParameterBounds) -> Float[Array, "2 2 _"]:
    low_u, high_u, low_v, high_v = (jnp.reshape(x, -1) for x in border)
    return jnp.stack([low_u, low_v, high_u, high_v]).reshape(2, 2, -1)


def project(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    tolerance: Array,
    max_steps: Array,
    idle: Bool[Array, " points"] | None = None,
    borders: bool = True,
    within: ParameterBounds | None = None,
) -> FootStates:
    """Foot points of `target` on the surface, from the starts (u, v); `idle` points stay where
    they are. With `borders` feet that do not converge are searched on the four border curves (section 3.1 of
    the paper). With `within`, bounds for each foot, feet are searched nowhere else.

    Centre the coordinates first: the rounding is estimated from their largest magnitude.
    """
    pieces = in_precision_of(target, pieces)
    limits = FootLimits.of(tolerance, jnp.max(jnp.abs(target)), max_steps)
    feet, bounds = initial_feet(pieces, u, v, idle, within, FOUND)
    if within is not None or not borders:
        return iterate_feet(method, pieces, target, feet, limits, bounds)[0]
    return _in_stages(method, pieces, target, feet, limits)


def _in_stages(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Array,
    feet: FootStates,
    limits: FootLimits,
) -> FootStates:
    """All stages: the whole domain, then one border after the other for feet that have not converged,
    then the whole domain again, from the nearest points found. So converged feet are feet of the whole
    surface.
    """

    def unfinished(carry: tuple[Array, FootStates]) -> Array:
        number, feet = carry
        return (number <= WHOLE_AGAIN) & jnp.any(~feet.converged)

    def stage(carry: tuple[Array, FootStates]) -> tuple[Array, FootStates]:
        number, old = carry
        border = _stage_bounds(pieces, number)
        budget = FootLimits(limits.tolerance, limits.noise, (number + 1) * limits.steps)
        begun = _begin(old, number, border)
        new, _ = iterate_feet(method, pieces, target, begun, budget, _as_bounds(border))
        return number + 1, _merge(old, new, number, limits)

    return lax.while_loop(unfinished, stage, (jnp.asarray(WHOLE_DOMAIN, jnp.int32), feet))[1]


def _stage_bounds(pieces: Pieces, number: Array) -> ParameterBounds:
    """The bounds of a stage: the domain, or one of its sides."""
    low_u, high_u, low_v, high_v = _domain(pieces)
    return (
        jnp.where(number == 2, high_u, low_u),
        jnp.where(number == 1, low_u, high_u),
        jnp.where(number == 4, high_v, low_v),
        jnp.where(number == 3, low_v, high_v),
    )


def _begin(old: FootStates, number: Array, border: ParameterBounds) -> FootStates:
    """The feet at the beginning of a stage. After stage 0, feet not converged start anew from their best."""
    low_u, high_u, low_v, high_v = border
    best_u, best_v = jnp.clip(old.best_u, low_u, high_u), jnp.clip(old.best_v, low_v, high_v)
    return select_feet(
        old.converged | (number == WHOLE_DOMAIN), old, FootStates.begin(best_u, best_v, steps=old.steps)
    )


def _merge(old: FootStates, new: FootStates, number: Array, limits: FootLimits) -> FootStates:
    """The feet after a stage. A border stage only takes nearer points, which do not count as converged."""
    nearer = new.squared_distance < old.squared_distance - limits.rounding_of(old.squared_distance)
    nearer = jnp.where(jnp.isinf(old.squared_distance), jnp.isfinite(new.squared_distance), nearer)
    whole = (number == WHOLE_DOMAIN) | (number == WHOLE_AGAIN)
    state = jnp.where(new.converged & whole, float(FOUND), float(GIVEN_UP)).astype(new.parts.dtype)
    spent = FootStates(jnp.concatenate([old.parts[:5], new.parts[5:]])).with_state(
        jnp.full_like(state, GIVEN_UP)
    )
    return select_feet(old.converged, old, select_feet(nearer | whole, new.with_state(state), spent))
