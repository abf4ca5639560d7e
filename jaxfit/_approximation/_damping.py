"""What a method remembers that may have to take a step back: the surface it trusts, and how it damps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._checks import is_concrete
from jaxfit._splines._pieces import Axis

# A step that brings less than the one share of the fall its model foresaw is damped more, beyond the other
# the next one is damped less.
POOR, GOOD = 0.25, 0.5
RAISED, LOWERED, TAKEN_BACK = 4.0, 0.25, 10.0  # factors of the damping
# Below its usual least value the damping is lowered only after steps that bring about all that was foreseen,
# and take off much of the objective: so convergence is superlinear where all points can be met.
EXCELLENT, MUCH, USUAL_DAMPING, LEAST_DAMPING = 0.9, 0.5, 1e-4, 1e-12
LONGEST_WAY = 4.0  # of a foot, in cells, in a step that brings less than GOOD


class Trust(eqx.Module):
    """The last accepted surface, its feet, and the step from it that is to be judged.

    `damping` lies between its least value and 1, where no step can fail. `foreseen` is by how much the
    objective should fall, `bending` the thin plate's part of it.
    """

    net: Float[Any, "nu nv d"]
    u: Float[Any, " points"]
    v: Float[Any, " points"]
    error: Float[Any, " points"]
    found: Bool[Any, " points"]
    bending: Float[Any, ""]
    foreseen: Float[Any, ""]
    damping: Float[Any, ""]
    retreats: Int[Any, ""]


def first_trust(net: Any, u: Any, v: Any) -> Trust:
    """Before anything has been measured."""
    xp: Any = np if is_concrete(net, u, v) else jnp
    zero, one = xp.zeros((), net.dtype), xp.ones((), net.dtype)
    none = xp.zeros(u.shape, bool)
    return Trust(net, u, v, xp.zeros_like(u), none, zero, zero, one, xp.zeros((), np.int32))


def is_plausible(trust: Trust, gain: Array, way: Array) -> Array:
    """Whether a step in which a foot went so far did what it was to do."""
    return (way < LONGEST_WAY) | (gain > GOOD * trust.foreseen) | (trust.damping >= 1)


def next_damping(trust: Trust, before: Array, gain: Array, good: Array) -> Array:
    """The damping of the step to come, by the fall of the objective against the fall foreseen."""
    superb = (gain > EXCELLENT * trust.foreseen) & (gain > MUCH * before)
    least = jnp.where(superb, LEAST_DAMPING, jnp.minimum(trust.damping, USUAL_DAMPING))
    factor = jnp.where(gain > GOOD * trust.foreseen, LOWERED, 1.0)
    factor = jnp.where(gain < POOR * trust.foreseen, RAISED, factor)
    factor = jnp.where(good, factor, TAKEN_BACK)
    return jnp.clip(trust.damping * factor, least, 1.0).astype(trust.damping.dtype)


def farthest_move(axes: tuple[Axis, Axis], before: Any, after: Any, counts: Array) -> Float[Array, ""]:
    """The longest way of a foot that counts, in widths of the cell it came from."""
    ways = []
    for axis, x, y in zip(jax.tree.map(jnp.asarray, axes), before, after, strict=True):
        ways.append(jnp.abs(y - x) / (2.0 * axis.half[axis.locate(x)]))
    return jnp.max(jnp.where(counts, jnp.maximum(*ways), 0.0))


def within_reach(
    net: Float[Array, "nu nv d"], move: Float[Array, "nu nv d"], reach: float
) -> Float[Array, "nu nv d"]:
    """Moves cut to a share of the distance to the neighbours, the nearer ones of both directions.

    A model that is linear in the control points says nothing of moves that carry a net across itself.
    """
    length = jnp.sqrt(jnp.sum(move**2, axis=-1))
    limit = reach * jnp.minimum(_spacing(net), _spacing(net.transpose(1, 0, 2)).T)
    far = length > limit
    share = jnp.where(far, limit / jnp.where(far, length, 1.0), 1.0)
    return share[:, :, None] * move


def _spacing(net: Float[Array, "n m d"]) -> Float[Array, "n m"]:
    """Mean distance to the neighbours along the first direction."""
    legs = jnp.sqrt(jnp.sum(jnp.diff(net, axis=0) ** 2, axis=-1))
    before, after = jnp.concatenate([legs[:1], legs]), jnp.concatenate([legs, legs[-1:]])
    return 0.5 * (before + after)
