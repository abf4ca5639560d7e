"""Damped steps: how a step is judged, and how much the next one is damped."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._splines._pieces import Axis

# A step that brings less than the one share of the fall its model foresaw is damped more, beyond the other
# the next one is damped less.
POOR, GOOD = 0.25, 0.5
RAISED, LOWERED, TAKEN_BACK = 4.0, 0.25, 10.0  # factors of the damping
# Below its usual least value the damping is lowered only after steps that bring about all that was foreseen,
# and take off much of the objective: so convergence is superlinear where all points can be met.
EXCELLENT, MUCH, USUAL_DAMPING, LEAST_DAMPING = 0.9, 0.5, 1e-4, 1e-12
LONGEST_WAY = 4.0  # of a foot, in cells, in a step that brings less than GOOD


class DampingState(eqx.Module):
    """The surface a step began from, and what it is judged by.

    `damping` lies between its least value and 1, where no step can fail. `energy` is the thin plate's part of
    the objective, `predicted` by how much the objective should fall.
    """

    origin: WorkingSurface
    energy: Float[Any, ""]
    predicted: Float[Any, ""]
    damping: Float[Any, ""]
    rejected_steps: Int[Any, ""]


def first_damping(surface: WorkingSurface, dtype: Any) -> DampingState:
    """Before anything has been measured."""
    zero, one = np.zeros((), dtype), np.ones((), dtype)
    return DampingState(surface, zero, zero, one, np.zeros((), np.int32))


def is_plausible(state: DampingState, gain: Array, way: Array) -> Array:
    """Whether a step in which a foot went so far did what it was to do."""
    return (way < LONGEST_WAY) | (gain > GOOD * state.predicted) | (state.damping >= 1)


def next_damping(state: DampingState, before: Array, gain: Array, good: Array) -> Array:
    """The damping of the step to come, by the fall of the objective against the fall predicted."""
    superb = (gain > EXCELLENT * state.predicted) & (gain > MUCH * before)
    least = jnp.where(superb, LEAST_DAMPING, jnp.minimum(state.damping, USUAL_DAMPING))
    factor = jnp.where(gain > GOOD * state.predicted, LOWERED, 1.0)
    factor = jnp.where(gain < POOR * state.predicted, RAISED, factor)
    factor = jnp.where(good, factor, TAKEN_BACK)
    return jnp.clip(state.damping * factor, least, 1.0).astype(state.damping.dtype)


def farthest_move(axes: tuple[Axis, Axis], before: Any, after: Any, counts: Array) -> Float[Array, ""]:
    """The longest way of a foot that counts, in widths of the cell it came from."""
    ways = []
    for axis, x, y in zip(jax.tree.map(jnp.asarray, axes), before, after, strict=True):
        ways.append(jnp.abs(y - x) / (2.0 * axis.half[axis.locate(x)]))
    return jnp.max(jnp.where(counts, jnp.maximum(*ways), 0.0))


def within_reach(
    net: Float[Array, "nu nv d"], move: Float[Array, "nu nv d"], reach: Any
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
