"""Feet on creases: a foot found on a crease also tries the smooth regions on the other sides.

A smooth region is what lies between neighbouring creases, in both directions. A foot stays within its own
until it finds a nearer foot across a crease.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxfit._cells import take
from jaxfit._closest._foot_states import FOUND, GOING, FootLimits, FootStates
from jaxfit._splines._pieces import Axis, Pieces

LAST_TRY = 3


class SmoothRegion(eqx.Module):
    """The smooth region of every foot, given by a cell in it, and those across the creases in u and in v.

    Bit 0 of `tries` says that the foot is now searched across the crease in u, bit 1 across that in v.
    """

    base: Int[Array, "2 points"]
    across: Int[Array, "2 points"]
    tries: Int[Array, "1 points"]
    before: Float[Array, "1 points"]  # squared distance when the tries began

    @property
    def cell(self) -> Int[Array, "2 points"]:
        """The cell that stands for the region that the foot is in now."""
        return jnp.where((self.tries & jnp.asarray([[1], [2]], jnp.int32)) > 0, self.across, self.base)


def initial_region(pieces: Pieces, feet: FootStates) -> SmoothRegion:
    """Every foot in the region it starts from."""
    u, v = feet.trial
    cell = jnp.stack([pieces.axis_u.locate(u), pieces.axis_v.locate(v)])
    return SmoothRegion(cell, cell, jnp.zeros_like(cell[:1]), jnp.full_like(feet.parts[4:5], jnp.inf))


def cells_of_regions(pieces: Pieces, region: SmoothRegion, cell_u: Array, cell_v: Array) -> list[Array]:
    """The cells of the trials, within the regions they are confined to."""
    axes = (pieces.axis_u, pieces.axis_v)
    parts = zip((cell_u, cell_v), axes, region.cell, strict=True)
    return [jnp.clip(cell, take(a.first, mine, 0), take(a.last, mine, 0)) for cell, a, mine in parts]


def cross_creases(
    pieces: Pieces, old: FootStates, new: FootStates, region: SmoothRegion, limits: FootLimits
) -> tuple[FootStates, SmoothRegion]:
    """Feet that have just been found on a crease are searched across it; the others do not change."""
    found, best = ((new.state == FOUND) & (old.state == GOING))[None], new.parts[4:5]
    begins = (region.tries == 0) | (best < region.before - limits.rounding_of(best))
    cell, axes = region.cell, (pieces.axis_u, pieces.axis_v)
    sides = [_across(a, x, mine) for a, x, mine in zip(axes, new.parts[2:4], cell, strict=True)]
    base, across = jnp.where(begins, cell, region.base), jnp.where(begins, jnp.stack(sides), region.across)
    tries, before = jnp.where(begins, 1, region.tries + 1), jnp.where(begins, best, region.before)
    goes_on = found & (across != base).any(0)[None] & (tries <= LAST_TRY)
    following = SmoothRegion(base, across, tries, before)
    # A foot that an earlier try has moved off a crease, by rounding, would wait for ever outside its region.
    for a, x, cell in zip(axes, new.trial, following.cell, strict=True):
        goes_on &= ((x >= take(a.low, cell, 0)) & (x <= take(a.high, cell, 0)))[None]
    after = jax.tree.map(partial(jnp.where, goes_on), following, region)
    return new.with_state(jnp.where(goes_on[0], float(GOING), new.state)), after


def _across(axis: Axis, u: Array, cell: Array) -> Array:
    """The cell just across the crease that u lies on, or `cell` if it lies on none."""
    at_low = (u <= take(axis.low, cell, 0)) & (u > axis.breaks[0])
    at_high = (u >= take(axis.high, cell, 0)) & (u < axis.breaks[-1])
    return jnp.where(at_low, take(axis.before, cell, 0), jnp.where(at_high, take(axis.after, cell, 0), cell))
