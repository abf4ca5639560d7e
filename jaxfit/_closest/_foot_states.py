"""`FootStates`, the feet during an iteration, and `FootLimits`, when the iteration ends."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

# States of a foot: still moving, found to the tolerance, or given up. The last two are found and given up
# feet that the sums already include.
GOING, FOUND, GIVEN_UP, SUMMED_FOUND, SUMMED_GIVEN_UP = range(5)


class FootStates(eqx.Module):
    """Trial parameters, and the best (last accepted) foot of every point.

    All numbers are in one array, so that a gather, a scatter or a selection is one operation. Its rows: trial
    u and v, best u and v, squared distance, evaluations, state.
    """

    parts: Float[Array, "7 points"]

    @staticmethod
    def begin(
        u: Float[Array, " points"], v: Float[Array, " points"], steps: Any = 0, state: Any = GOING
    ) -> "FootStates":
        """Feet that have not been evaluated yet."""
        numbers = (jnp.broadcast_to(jnp.asarray(x, u.dtype), u.shape) for x in (jnp.inf, steps, state))
        return FootStates(jnp.stack([u, v, u, v, *numbers]))

    @property
    def trial(self) -> Float[Array, "2 points"]:
        """Parameters to be evaluated next."""
        return self.parts[:2]

    @property
    def best_u(self) -> Float[Array, " points"]:
        """Parameter of the last accepted foot."""
        return self.parts[2]

    @property
    def best_v(self) -> Float[Array, " points"]:
        """Parameter of the last accepted foot."""
        return self.parts[3]

    @property
    def squared_distance(self) -> Float[Array, " points"]:
        """Squared distance of the last accepted foot, infinite before the first evaluation."""
        return self.parts[4]

    @property
    def steps(self) -> Int[Array, " points"]:
        """Evaluations so far."""
        return self.parts[5].astype(jnp.int32)

    @property
    def state(self) -> Float[Array, " points"]:
        """One of the constants above."""
        return self.parts[6]

    @property
    def converged(self) -> Bool[Array, " points"]:
        """Whether the foot has been found to the tolerance."""
        return (self.state == FOUND) | (self.state == SUMMED_FOUND)

    def with_state(self, state: Float[Array, " points"]) -> "FootStates":
        """The same feet in another state."""
        return FootStates(jnp.concatenate([self.parts[:6], state[None]]))


class FootLimits(eqx.Module):
    """The tolerance for a foot, and the largest number of evaluations.

    `tolerance` is the allowed tangential part of the residual, a length; `noise` the rounding of one.
    """

    tolerance: Float[Array, ""]
    noise: Float[Array, ""]
    steps: Float[Array, ""]

    @staticmethod
    def of(tolerance: Any, reach: Float[Array, ""], steps: Any) -> "FootLimits":
        """With no tolerance below the rounding of a residual; no coordinate is larger than `reach`."""
        noise = 4.0 * jnp.finfo(reach.dtype).eps * reach
        tolerance = jnp.maximum(jnp.asarray(tolerance, reach.dtype), 4.0 * noise)
        # Of points that are not finite it is a number, too: the steps are counted where it is below infinity.
        tolerance = jnp.where(jnp.isnan(tolerance), 0.0, tolerance)
        return FootLimits(tolerance, noise, jnp.asarray(steps, reach.dtype))

    def rounding_of(self, f: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Rounding of a squared distance."""
        return self.noise * (2.0 * jnp.sqrt(f) + self.noise)


def is_going(feet: FootStates, limits: FootLimits) -> Bool[Array, " points"]:
    """Which feet still move: neither found nor given up, with evaluations left."""
    return (feet.state == GOING) & (feet.parts[5] < limits.steps)


def select_feet(which: Bool[Array, " points"], old: FootStates, new: FootStates) -> FootStates:
    """`old` where `which`, `new` elsewhere."""
    return FootStates(jnp.where(which[None], old.parts, new.parts))
