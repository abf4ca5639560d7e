"""Extrapolation of converging feet: in the next iteration they start ahead by most of their last step."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._checks import is_concrete
from jaxfit._splines._pieces import Axis

SHARE = 0.9  # of the last step, which the next one resembles
FARTHEST = 0.25  # in spans
MAX_GROWTH = 3.0  # a step this many times as long as the last one predicts nothing


class FootExtrapolation(eqx.Module):
    """The last step of all feet, and its length (root mean square)."""

    last_step: Float[Any, "2 points"]
    rms_step: Float[Any, ""]

    @staticmethod
    def initial(u: Any) -> "FootExtrapolation":
        """Before the first step; `u` gives shape and type."""
        xp: Any = np if is_concrete(u) else jnp
        return FootExtrapolation(xp.zeros((2, *u.shape), u.dtype), xp.asarray(np.inf, u.dtype))

    def predict(self, axes: tuple[Axis, Axis], u: Array, v: Array) -> tuple[Array, Array]:
        """The start of feet at (u, v): within the domain, and at most FARTHEST away."""
        starts = []
        for axis, x, step in zip(axes, (u, v), self.last_step, strict=True):
            low, high = axis.breaks[0], axis.breaks[-1]
            farthest = FARTHEST * (high - low) / axis.cells
            starts.append(jnp.clip(x + lax.clamp(-farthest, SHARE * step, farthest), low, high))
        return starts[0], starts[1]

    def after(self, step: Float[Array, "2 points"]) -> "FootExtrapolation":
        """The state after `step`.

        A step that is much longer than the last one, as after fairing or new knots, is not extrapolated.
        """
        rms = jnp.sqrt(jnp.vdot(step, step) / step.size)
        return FootExtrapolation(jnp.where(rms > MAX_GROWTH * self.rms_step, 0.0, step), rms)
