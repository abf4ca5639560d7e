"""Foot points on their way, and what they have to reach."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

# States of a foot. What the caller sums over the points has been taken from those from SUMMED_FOUND on.
GOING, FOUND, GIVEN_UP, SUMMED_FOUND, SUMMED_GIVEN_UP = range(5)


class Feet(eqx.Module):
    """Trial parameters, and the best (last accepted) foot of every point.

    One array, so that gathering, scattering and choosing are one operation each: trial u and v, best u and v,
    squared distance, evaluations, state.
    """

    parts: Float[Array, "7 points"]

    @staticmethod
    def begin(
        u: Float[Array, " points"], v: Float[Array, " points"], steps: Any = 0, state: Any = GOING
    ) -> "Feet":
        """Feet that have not been evaluated yet."""
        numbers = (jnp.broadcast_to(jnp.asarray(x, u.dtype), u.shape) for x in (jnp.inf, steps, state))
        return Feet(jnp.stack([u, v, u, v, *numbers]))

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
    def best(self) -> Float[Array, " points"]:
        """Squared distance of the last accepted foot, infinite before the first evaluation."""
        return self.parts[4]

    @property
    def steps(self) -> Int[Array, " points"]:
        """Evaluations so far."""
        return self.parts[5].astype(jnp.int32)

    @property
    def state(self) -> Float[Array, " points"]:
        """GOING, FOUND to the tolerance, GIVEN_UP, or one of the latter with its part of the sums taken."""
        return self.parts[6]

    @property
    def converged(self) -> Bool[Array, " points"]:
        """Whether the foot has been found to the tolerance."""
        return (self.state == FOUND) | (self.state == SUMMED_FOUND)

    def with_state(self, state: Float[Array, " points"]) -> "Feet":
        """The same feet in another state."""
        return Feet(jnp.concatenate([self.parts[:6], state[None]]))


class Limits(eqx.Module):
    """What a foot has to reach, and with how many evaluations.

    `tolerance` is the allowed tangential part of the residual, a length; `noise` the rounding of one.
    """

    tolerance: Float[Array, ""]
    noise: Float[Array, ""]
    steps: Float[Array, ""]

    @staticmethod
    def of(tolerance: Any, reach: Float[Array, ""], steps: Any) -> "Limits":
        """With no tolerance below the rounding of a residual; no coordinate is larger than `reach`."""
        noise = 4.0 * jnp.finfo(reach.dtype).eps * reach
        tolerance = jnp.maximum(jnp.asarray(tolerance, reach.dtype), 4.0 * noise)
        return Limits(tolerance, noise, jnp.asarray(steps, reach.dtype))

    def slack(self, f: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Rounding of a squared distance."""
        return self.noise * (2.0 * jnp.sqrt(f) + self.noise)


def is_going(feet: Feet, limits: Limits) -> Bool[Array, " points"]:
    """Which feet are to be moved on."""
    return (feet.state == GOING) & (feet.parts[5] < limits.steps)


def keep(which: Bool[Array, " points"], old: Feet, new: Feet) -> Feet:
    """`old` where `which`, `new` elsewhere."""
    return Feet(jnp.where(which[None], old.parts, new.parts))
