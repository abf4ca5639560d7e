"""Bounds on the parameters of feet, and the local coordinates of their cells."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._cells import Rows, take
from jaxfit._closest._forms import Forms, both
from jaxfit._splines._pieces import Pieces


class Bounds(NamedTuple):
    """Bounds on the parameters, and the cell whose polynomial is evaluated, of every slot.

    `rate` is 1 over half the cell's width: multiplying is cheaper than dividing.
    """

    low: Float[Array, "2 1 slots"]
    high: Float[Array, "2 1 slots"]
    centre: Float[Array, "2 1 slots"]
    half: Float[Array, "2 1 slots"]
    rate: Float[Array, "2 1 slots"]

    def local(self, x: Float[Array, "2 1 slots"]) -> Float[Array, "2 1 slots"]:
        """Local coordinates of parameters."""
        return (x - self.centre) * self.rate

    def clip_step(
        self, x: Float[Array, "2 1 slots"], step: Float[Array, "2 1 slots"]
    ) -> Float[Array, "2 1 slots"]:
        """A step in local coordinates, cut off at the bounds."""
        return lax.clamp((self.low - x) * self.rate, step, (self.high - x) * self.rate)

    def end_of_step(
        self, x: Float[Array, "2 1 slots"], step: Float[Array, "2 1 slots"]
    ) -> Float[Array, "2 1 slots"]:
        """Where a step ends; one cut off at a bound ends on the bound to the last bit."""
        end = lax.clamp(self.low, x + step * self.half, self.high)
        end = lax.select(step <= (self.low - x) * self.rate, self.low, end)
        return lax.select(step >= (self.high - x) * self.rate, self.high, end)


def bounds_of_cells(pieces: Pieces, third: Float[Array, " cells"]) -> Float[Array, "cells 11"]:
    """For each cell its `Bounds`, and the bound on its third derivatives."""
    axes = (pieces.axis_u, pieces.axis_v)
    along_u, along_v = (jnp.concatenate([a.bounds, 1.0 / a.half[None]]).T for a in axes)
    cells = (axes[0].cells, axes[1].cells, 5)
    pairs = jnp.stack(
        [jnp.broadcast_to(along_u[:, None], cells), jnp.broadcast_to(along_v[None], cells)], axis=3
    )
    return jnp.concatenate([pairs.reshape(-1, 10).astype(third.dtype), third[:, None]], axis=1)


def bounds_of_slots(
    cells: Float[Array, "cells 11"], part: Rows, within: Float[Array, "2 2 _"] | None
) -> tuple[Bounds, Float[Array, "1 1 slots"]]:
    """The entries of `bounds_of_cells` for the slots of some rows, in one line.

    `within` are narrower bounds (lower and upper, u and v), of all points or of each.
    """
    rows, width = part.point.shape
    wide = jnp.broadcast_to(take(cells, part.cell, 0).T[..., None], (11, rows, width)).reshape(11, 1, -1)
    *pairs, third = lax.split(wide, (2, 2, 2, 2, 2, 1))
    bounds = Bounds(*pairs)
    if within is not None:
        if within.shape[2] > 1:
            within = part.spread(within.reshape(4, -1)).reshape(2, 2, -1)
        low, high = jnp.maximum(bounds.low, within[0][:, None]), jnp.minimum(bounds.high, within[1][:, None])
        bounds = bounds._replace(low=low, high=high)
    return bounds, third


def active_bounds(
    forms: Forms, x: Float[Array, "2 1 slots"], bounds: Bounds, tolerance: Float[Array, ""]
) -> tuple[Bool[Array, "2 1 slots"], Bool[Array, "1 1 slots"]]:
    """Which bounds are active by the sign of the gradient, and whether the free coordinates have converged.

    Converged: the components of the residual along the free tangents, lengths, are below the tolerance.
    """
    g, square = forms.gradient, tolerance**2
    # Moving along a tangent so short changes nothing: curves along v, poles.
    fixed = (bounds.high <= bounds.low) | (forms.metric <= square)
    active = fixed | lax.select(g < 0, x <= bounds.low, x >= bounds.high)
    return active, both(active | (g * g <= square * forms.metric))
