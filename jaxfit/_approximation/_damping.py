"""The damping of `OrthogonalDistance`: when a step is accepted, and how much the next one is damped."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._splines._pieces import Axis
from jaxfit._unrolling import root

# The ratio of the actual to the predicted reduction: below POOR the damping rises, above GOOD it falls.
POOR, GOOD = 0.25, 0.5
RAISED, LOWERED, TAKEN_BACK = 4.0, 0.25, 10.0  # factors of the damping
# The damping falls below its usual minimum only after steps that achieve the predicted reduction and remove
# a good part of the objective. Convergence is then superlinear where all points can be met. Otherwise a lower
# minimum lets the net slide far for little, into folds, and makes the steps sensitive to rounding. Where the
# mean distance is below SMALL, a share of the diagonal, a smaller part is enough: a net that has to slide
# along the surface to meet all points gains a few per cent a step until it is damped less.
EXCELLENT, MUCH, LEAST_DAMPING = 0.9, 0.3, 1e-12
SMALL = 2e-4
# The predicted reduction is that of the damped problem. The actual one comes to twice as much where nothing
# but the damping keeps the step short. A net with a free border is damped less then, however little such a
# step removes: it has a long way to slide. One whose border is held would slide into folds beside it.
LIMITED = 1.95
USUAL_DAMPING, GUARDED_DAMPING = 1e-4, 1e-3  # the latter where folds are kept out
# Steps damped less get a second-order correction. Earlier ones come no closer with it, for each solves
# another problem than the last one, with less damping and smoothing.
CORRECTED_BELOW = 2e-3
LONGEST_MOVE = 4.0  # of a foot, in cells, in a step whose reduction is not GOOD


class DampingState(eqx.Module):
    """The surface a step began from, and what decides whether it is accepted.

    `predicted` is the predicted reduction of the objective. `damping` lies between its minimum and 1, at
    which no step can fail.
    """

    origin: WorkingSurface
    predicted: Float[Any, ""]
    damping: Float[Any, ""]
    rejected_steps: Int[Any, ""]


def first_damping(surface: WorkingSurface, dtype: Any) -> DampingState:
    """The state before the first step, whose damping is 1."""
    zero, one = np.zeros((), dtype), np.ones((), dtype)
    return DampingState(surface, zero, one, np.zeros((), np.int32))


def actual_gain(state: DampingState, before: Array, after: Array) -> Array:
    """By how much the objective has fallen; by nothing where all control points are held."""
    return lax.select(state.predicted == 0, np.zeros((), before.dtype), before - after)


def is_no_worse(state: DampingState, gain: Array, longest_move: Array) -> Array:
    """Whether the objective has not risen, and no foot moved far or else the `gain` is what was predicted."""
    plausible = (longest_move < LONGEST_MOVE) | (gain > GOOD * state.predicted) | (state.damping >= 1)
    return (gain >= 0) & plausible


def next_damping(
    state: DampingState,
    before: Array,
    average: Any,
    gain: Array,
    good: Array,
    usual: Any = USUAL_DAMPING,
    border_is_free: bool = False,
) -> Array:
    """The damping of the next step, from the actual reduction `gain` and the predicted one. `average` is the
    mean distance as a share of the diagonal.
    """
    damping, predicted = jnp.asarray(state.damping), state.predicted
    constants = 1.0, LOWERED, RAISED, TAKEN_BACK, LEAST_DAMPING
    one, lowered, raised, taken_back, least = (np.asarray(x, damping.dtype) for x in constants)
    much = MUCH * jnp.minimum(average / SMALL, 1.0) ** 1.5
    superb = (gain > EXCELLENT * predicted) & (gain > much * before)
    if border_is_free:  # the predicted reduction may be negative where moves were shortened
        superb |= (gain > LIMITED * predicted) & (predicted > 0)
    factor = lax.select(gain > GOOD * predicted, lowered, one)
    factor = lax.select(gain < POOR * predicted, raised, factor)
    factor = lax.select(good, factor, taken_back)
    return lax.clamp(jnp.where(superb, least, usual), damping * factor, one)


def farthest_move(axes: tuple[Axis, Axis], before: Any, after: Any, counts: Array) -> Float[Array, ""]:
    """The longest move of a foot that counts, in widths of the cell it came from."""
    ways = []
    for axis, x, y in zip(jax.tree.map(jnp.asarray, axes), before, after, strict=True):
        ways.append(jnp.abs(y - x) / (2.0 * axis.half[axis.locate(x)]))
    return jnp.max(jnp.where(counts, jnp.maximum(*ways), 0.0))


def longest_moves(net: Float[Array, "nu nv d"], reach: Any, used: Any) -> Float[Array, "nu nv"]:
    """How far each control point may move: a share of the distance to its nearer neighbours in the net.

    The linear model of the residuals does not hold for moves that fold the net. Surplus control points,
    which are behind the `used` ones, are nobody's neighbours.
    """
    return reach * jnp.minimum(_spacing(net, used[0]), _spacing(net.transpose(1, 0, 2), used[1]).T)


def within_reach(move: Float[Array, "nu nv d"], longest: Float[Array, "nu nv"]) -> Float[Array, "nu nv d"]:
    """The move of each control point, no longer than it may be."""
    length = root(jnp.sum(move**2, axis=-1))
    far = length > longest
    return jnp.where(far, longest / jnp.where(far, length, 1.0), 1.0)[:, :, None] * move


def _spacing(net: Float[Array, "n m d"], used: Any) -> Float[Array, "n m"]:
    """Mean distance to the neighbours along the first direction."""
    legs = root(jnp.sum(jnp.diff(net, axis=0) ** 2, axis=-1))
    before, after = jnp.concatenate([legs[:1], legs]), jnp.concatenate([legs, legs[-1:]])
    last = np.arange(net.shape[0])[:, None] == used - 1
    return 0.5 * (before + jnp.where(last, before, after))
