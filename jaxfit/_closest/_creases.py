"""Feet on creases: one that has arrived there tries the smooth stretches on its other sides.

Bounds of the iteration are those of the smooth stretch a foot is in, which it calls home until it finds a
nearer foot across a crease.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxfit._closest._feet import ARRIVED, GOING, Feet, Limits
from jaxfit._splines._pieces import Axis, Pieces

LAST_TRY = 3


class Home(eqx.Module):
    """The smooth stretch of every foot, given by a cell in it, and the one across the crease.

    Bit 0 of `tries` says that the foot now looks across the crease in u, bit 1 across that in v.
    """

    base_u: Int[Array, " points"]
    base_v: Int[Array, " points"]
    across_u: Int[Array, " points"]
    across_v: Int[Array, " points"]
    tries: Int[Array, " points"]
    before: Float[Array, " points"]  # squared distance when the tries began

    @property
    def u(self) -> Int[Array, " points"]:
        """The cell that stands for the stretch along u."""
        return jnp.where(self.tries % 2 == 1, self.across_u, self.base_u)

    @property
    def v(self) -> Int[Array, " points"]:
        """The cell that stands for the stretch along v."""
        return jnp.where(self.tries >= 2, self.across_v, self.base_v)


def at_home(pieces: Pieces, feet: Feet) -> Home:
    """Every foot in the stretch it starts from."""
    home_u, home_v = pieces.axis_u.locate(feet.u), pieces.axis_v.locate(feet.v)
    return Home(home_u, home_v, home_u, home_v, jnp.zeros_like(home_u), jnp.full_like(feet.best, jnp.inf))


def home_cells(pieces: Pieces, home: Home, cell_u: Array, cell_v: Array) -> tuple[Array, Array]:
    """The cells of the trials, within the stretches they are confined to."""
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    cell_u = jnp.clip(cell_u, axis_u.first[home.u], axis_u.last[home.u])
    return cell_u, jnp.clip(cell_v, axis_v.first[home.v], axis_v.last[home.v])


def cross_creases(pieces: Pieces, old: Feet, new: Feet, home: Home, limits: Limits) -> tuple[Feet, Home]:
    """Send feet that have just arrived on a crease to look across it; the rest stay as they are."""
    arrived = (new.state == ARRIVED) & (old.state == GOING)
    gained = new.best < home.before - limits.slack(new.best)
    begins = (home.tries == 0) | gained
    side_u = _across(pieces.axis_u, new.best_u, home.u)
    side_v = _across(pieces.axis_v, new.best_v, home.v)
    fresh = Home(home.u, home.v, side_u, side_v, jnp.ones_like(home.tries), new.best)
    later = eqx.tree_at(lambda x: x.tries, home, home.tries + 1)
    after = jax.tree.map(lambda a, b: jnp.where(begins, a, b), fresh, later)
    creased = (after.across_u != after.base_u) | (after.across_v != after.base_v)
    goes_on = arrived & creased & (after.tries <= LAST_TRY)
    home = jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), after, home)
    return new.standing(jnp.where(goes_on, GOING, new.state)), home


def _across(axis: Axis, u: Array, home: Array) -> Array:
    """The cell just across the crease that u lies on, or `home` if it lies on none."""
    at_low = (u <= axis.low[home]) & (u > axis.breaks[0])
    at_high = (u >= axis.high[home]) & (u < axis.breaks[-1])
    return jnp.where(at_low, axis.before[home], jnp.where(at_high, axis.after[home], home))
