"""What converging feet start with in the next iteration."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._cells import KeptRows
from jaxfit._checks import is_concrete
from jaxfit._splines._pieces import Axis, Pieces

LEAD = 0.9  # feet start ahead by so much of their last move, which the next one resembles
FARTHEST_LEAD = 0.25  # in spans
LEAP = 3.0  # a move this many times as long as the last is a leap


class Ahead(eqx.Module):
    """The last move of all feet, where it leads on, its length (root mean square), the rows they were in, and
    who is `gone` from the cell of its row.
    """

    drift: Float[Any, "2 points"]
    pace: Float[Any, ""]
    gone: Bool[Any, " points"]
    kept: KeptRows

    @staticmethod
    def none(u: Any, cells: int) -> "Ahead":
        """Before the first move of feet with parameters `u`, one of two, on so many cells."""
        xp: Any = np if is_concrete(u) else jnp
        still, any_pace = xp.zeros((2, *u.shape), u.dtype), xp.asarray(np.inf, u.dtype)
        return Ahead(still, any_pace, still[0] < 0, KeptRows.none(u.shape[0], cells))

    def followed(
        self, pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"], left_out: Array
    ) -> "Ahead":
        """With rows for feet that start at (u, v)."""
        kept = self.kept.followed(pieces, u, v, left_out, self.gone)
        return Ahead(self.drift, self.pace, self.gone, kept)

    def after(self, moved: Float[Array, "2 points"], gone: Bool[Array, " points"]) -> "Ahead":
        """What a move leaves. A leap, as after fairing or new knots, does not lead on: what follows is not
        like it.
        """
        pace = jnp.sqrt(jnp.vdot(moved, moved) / moved.size)
        return Ahead(jnp.where(pace > LEAP * self.pace, 0.0, moved), pace, gone, self.kept)

    def led(self, axes: tuple[Axis, Axis], u: Array, v: Array) -> tuple[Array, Array]:
        """Where feet at (u, v) start."""
        return _led(axes[0], u, self.drift[0]), _led(axes[1], v, self.drift[1])


def _led(axis: Axis, u: Array, drift: Array) -> Array:
    """The parameter ahead, within the domain; not so far that it may be near another foot."""
    low, high = axis.breaks[0], axis.breaks[-1]
    farthest = FARTHEST_LEAD * (high - low) / axis.cells
    return jnp.clip(u + jnp.clip(LEAD * drift, -farthest, farthest), low, high)
