"""The last few feet, or few points from the start: blocks of points, each with its own cell.

Here creases and borders get their due. Bounds are those of the smooth stretch that a foot is in; a foot that
has arrived on a crease tries the stretches on its other sides before it counts as found. A foot that does
not arrive at all is looked for on the four border curves (section 3.1 of the paper).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._closest._feet import Box, Feet, advance, keep, new_feet
from jaxfit._closest._steps import AbstractFootMethod
from jaxfit._splines._pieces import Axis, Pieces

BLOCK = 1024
STEPS_PER_PASS = 6
EVERYWHERE, AGAIN = 0, 5  # stages; those between are the four borders
LAST_TRY = 3


class Home(eqx.Module):
    """The smooth stretch of every foot, given by a cell in it, and the one across the crease.

    Bit 0 of `tries` says that the foot now looks across the crease in u, bit 1 across that in v.
    """

    base_u: Int[Array, " block"]
    base_v: Int[Array, " block"]
    across_u: Int[Array, " block"]
    across_v: Int[Array, " block"]
    tries: Int[Array, " block"]
    before: Float[Array, " block"]  # squared distance when the tries began

    @property
    def u(self) -> Int[Array, " block"]:
        """The cell that stands for the stretch along u."""
        return jnp.where(self.tries % 2 == 1, self.across_u, self.base_u)

    @property
    def v(self) -> Int[Array, " block"]:
        """The cell that stands for the stretch along v."""
        return jnp.where(self.tries >= 2, self.across_v, self.base_v)


def finish(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    feet: Feet,
    tolerance: Array,
    noise: Array,
    max_steps: Array,
    borders: bool = True,
) -> Feet:
    """Iterate all feet that are not done, block by block, then those without success on the borders.

    Stages: 0 everywhere; 1-4 one border each, for feet that have not converged; 5 everywhere again,
    from the nearest of what was found, so that "converged" always means: with respect to the whole
    surface. A stage makes several passes, each over the feet that the last one has left. Without
    `borders` there is stage 0 only.
    """
    passes = -(-max_steps // STEPS_PER_PASS)

    def unsettled(carry: tuple[Array, Feet]) -> Array:
        number, feet = carry
        return (number <= AGAIN) & jnp.any(~feet.converged)

    def iterate(number: Array, feet: Feet) -> Feet:
        border = _border(pieces, number)

        def going(x: tuple[Array, Feet]) -> Array:
            return (x[0] < passes) & jnp.any(~x[1].done)

        def one(x: tuple[Array, Feet]) -> tuple[Array, Feet]:
            return x[0] + 1, _pass(method, pieces, target, x[1], border, tolerance, noise)

        return lax.while_loop(going, one, (jnp.asarray(0), feet))[1]

    def stage(carry: tuple[Array, Feet]) -> tuple[Array, Feet]:
        number, old = carry
        new = iterate(number, _begin(old, number, _border(pieces, number)))
        return number + 1, _merge(old, new, number, noise)

    if not borders:
        return iterate(jnp.asarray(EVERYWHERE), feet)
    return lax.while_loop(unsettled, stage, (jnp.asarray(EVERYWHERE), feet))[1]


def _border(pieces: Pieces, number: Array) -> tuple[Array, ...]:
    """Bounds (low_u, high_u, low_v, high_v) of a stage: the domain, or one of its sides."""
    bounds = []
    for axis, low_side in ((pieces.axis_u, 1), (pieces.axis_v, 3)):
        first, last = axis.breaks[0], axis.breaks[-1]
        bounds.append(jnp.where(number == low_side + 1, last, first))
        bounds.append(jnp.where(number == low_side, first, last))
    return tuple(bounds)


def _begin(old: Feet, number: Array, border: tuple[Array, ...]) -> Feet:
    """The feet a stage works on; after the first, those not converged, afresh from their best."""
    low_u, high_u, low_v, high_v = border
    fresh = new_feet(jnp.clip(old.best_u, low_u, high_u), jnp.clip(old.best_v, low_v, high_v))
    whole = jnp.stack([fresh.halvings, old.steps, old.whole[3], fresh.whole[3]])
    fresh = Feet(fresh.real, whole)
    return keep(jnp.broadcast_to(number == EVERYWHERE, old.done.shape), old, fresh)


def _merge(old: Feet, new: Feet, number: Array, noise: Array) -> Feet:
    """What a stage found; on a border only what is nearer, which has not converged by that."""
    new = new.marked(jnp.ones_like(new.done), new.converged)
    nearer = new.best < old.best - noise * (2.0 * jnp.sqrt(old.best) + noise)
    nearer = jnp.where(jnp.isinf(old.best), jnp.isfinite(new.best), nearer)
    on_border = new.marked(new.done, jnp.zeros_like(new.converged))
    whole = jnp.broadcast_to((number == EVERYWHERE) | (number == AGAIN), old.done.shape)
    return keep(old.converged, old, keep(whole, new, keep(nearer, on_border, old)))


def _pass(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Array,
    feet: Feet,
    border: tuple[Array, ...],
    tolerance: Array,
    noise: Array,
) -> Feet:
    """A few steps for every foot that is not done."""
    points = target.shape[1]
    size = min(BLOCK, points)
    wanted = ~feet.done
    slot = jnp.where(wanted, jnp.cumsum(wanted) - 1, points)
    chosen = jnp.full(points + -points % size, points, jnp.int32)
    chosen = chosen.at[slot].set(jnp.arange(points, dtype=jnp.int32), mode="drop")
    count = jnp.sum(wanted)

    def block(carry: tuple[Array, Feet]) -> tuple[Array, Feet]:
        start, feet = carry
        index = lax.dynamic_slice(chosen, (start,), (size,))
        inside = jnp.minimum(index, points - 1)
        mine = Feet(feet.real[:, inside], feet.whole[:, inside])
        mine = mine.marked(mine.done | (index >= points), mine.converged)
        mine = _run(method, pieces, target[:, inside], mine, border, tolerance, noise)
        real = feet.real.at[:, index].set(mine.real, mode="drop")
        whole = feet.whole.at[:, index].set(mine.whole, mode="drop")
        return start + size, Feet(real, whole)

    return lax.while_loop(lambda x: x[0] < count, block, (jnp.asarray(0), feet))[1]


def _run(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Array,
    feet: Feet,
    border: tuple[Array, ...],
    tolerance: Array,
    noise: Array,
) -> Feet:
    """STEPS_PER_PASS steps of one block, and more while feet look across creases."""
    home_u, home_v = pieces.axis_u.locate(feet.best_u), pieces.axis_v.locate(feet.best_v)
    zero = jnp.zeros_like(home_u)
    # A pass may have ended while looking across a crease; trials start within the home stretch.
    trial_u = jnp.clip(feet.u, pieces.axis_u.low[home_u], pieces.axis_u.high[home_u])
    trial_v = jnp.clip(feet.v, pieces.axis_v.low[home_v], pieces.axis_v.high[home_v])
    feet = Feet(jnp.stack([trial_u, trial_v, *feet.real[2:]]), feet.whole)
    home = Home(home_u, home_v, home_u, home_v, zero, jnp.full_like(feet.best, jnp.inf))

    def unfinished(carry: tuple[Array, Feet, Home]) -> Array:
        count, feet, home = carry
        looking = jnp.any((home.tries > 0) & ~feet.done) & (count < 10 * STEPS_PER_PASS)
        return jnp.any(~feet.done) & ((count < STEPS_PER_PASS) | looking)

    def body(carry: tuple[Array, Feet, Home]) -> tuple[Array, Feet, Home]:
        count, feet, home = carry
        cell, box = _box(pieces, feet, home, border)
        coefficients = jnp.moveaxis(pieces.coefficients[cell], 0, -1)
        new = advance(method, feet, list(target), coefficients, box, tolerance, noise)
        return count + 1, *_cross_creases(pieces, feet, new, home, noise)

    return lax.while_loop(unfinished, body, (jnp.asarray(0), feet, home))[1]


def _box(pieces: Pieces, feet: Feet, home: Home, border: tuple[Array, ...]) -> tuple[Array, Box]:
    """The cell of every foot within its home stretch, and its bounds."""
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    cell_u = jnp.clip(axis_u.locate(feet.u), axis_u.first[home.u], axis_u.last[home.u])
    cell_v = jnp.clip(axis_v.locate(feet.v), axis_v.first[home.v], axis_v.last[home.v])
    low_u, high_u, low_v, high_v = border
    box = Box(
        jnp.maximum(axis_u.low[home.u], low_u),
        jnp.minimum(axis_u.high[home.u], high_u),
        jnp.maximum(axis_v.low[home.v], low_v),
        jnp.minimum(axis_v.high[home.v], high_v),
        axis_u.centre[cell_u],
        axis_u.half[cell_u],
        axis_v.centre[cell_v],
        axis_v.half[cell_v],
    )
    return cell_u * axis_v.cells + cell_v, box


def _cross_creases(pieces: Pieces, old: Feet, new: Feet, home: Home, noise: Array) -> tuple[Feet, Home]:
    """Send feet that have just arrived on a crease to look across it; the rest stay as they are."""
    arrived = new.converged & ~old.done
    gained = new.best < home.before - noise * (2.0 * jnp.sqrt(new.best) + noise)
    begins = (home.tries == 0) | gained
    side_u = _across(pieces.axis_u, new.best_u, home.u)
    side_v = _across(pieces.axis_v, new.best_v, home.v)
    fresh = Home(home.u, home.v, side_u, side_v, jnp.ones_like(home.tries), new.best)
    later = eqx.tree_at(lambda x: x.tries, home, home.tries + 1)
    after = jax.tree.map(lambda a, b: jnp.where(begins, a, b), fresh, later)
    creased = (after.across_u != after.base_u) | (after.across_v != after.base_v)
    goes_on = arrived & creased & (after.tries <= LAST_TRY)
    home = jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), after, home)
    return new.marked(new.done & ~goes_on, new.converged & ~goes_on), home


def _across(axis: Axis, u: Array, home: Array) -> Array:
    """The cell just across the crease that u lies on, or `home` if it lies on none."""
    at_low = (u <= axis.low[home]) & (u > axis.breaks[0])
    at_high = (u >= axis.high[home]) & (u < axis.breaks[-1])
    return jnp.where(at_low, axis.before[home], jnp.where(at_high, axis.after[home], home))
