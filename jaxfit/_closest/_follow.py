"""Feet that follow a moving surface, one step for each of its moves."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxfit._barrier import materialise
from jaxfit._cells import Jet, in_line, in_rows
from jaxfit._closest._box import RowBox, Sides
from jaxfit._closest._feet import LONGEST_STEP, landing, pins, within
from jaxfit._closest._steps import AbstractFootMethod, Forms, measure


def follow(
    method: AbstractFootMethod,
    e: Float[Array, "d slots"],
    jet: Jet,
    u: Float[Array, " slots"],
    v: Float[Array, " slots"],
    box: RowBox,
    tolerance: Float[Array, ""],
) -> tuple[Float[Array, " slots"], Float[Array, " slots"], Float[Array, "d slots"]]:
    r"""One step from feet near their own: where they land, and the residual foreseen there.

    To first order the residual after a step $(\delta u, \delta v)$ is $e - R_u \delta u - R_v \delta v$. A
    step that would lengthen it is cut to where it is shortest. The slots of all rows are in one line; `box`
    has one entry a row.
    """
    always = tolerance < jnp.inf
    first = materialise(always, lambda e, jet: measure(e, jet, method.drift), e, jet)
    pinned_s, pinned_t, settled = pins_in_line(always, first, u, v, box, tolerance)
    ds, dt = method.step(first, pinned_s, pinned_t, settled, always)

    def landed(first: Forms, u: Array, v: Array, ds: Array, dt: Array, settled: Array) -> tuple[Array, ...]:
        sides = box.along_rows()
        ds, dt = _shortened(first, u, v, ds, dt, settled, sides)
        next_u = landing(u, ds, sides.low_u, sides.high_u, sides.half_u, sides.rate_u)
        return next_u, landing(v, dt, sides.low_v, sides.high_v, sides.half_v, sides.rate_v), ds, dt

    x = rowwise((first, u, v, ds, dt, settled), box)
    next_u, next_v, ds, dt = (in_line(x) for x in materialise(always, landed, *x))
    return next_u, next_v, e - ds[None] * jet.s - dt[None] * jet.t


def pins_in_line(
    always: Array, first: Forms, u: Array, v: Array, box: RowBox, tolerance: Array
) -> tuple[Array, Array, Array]:
    """`pins` for slots in line."""
    found = materialise(
        always,
        lambda first, u, v: pins(first, u, v, box.along_rows(), tolerance),
        *rowwise((first, u, v), box),
    )
    pinned_s, pinned_t, settled = (in_line(x) for x in found)
    return pinned_s, pinned_t, settled


def rowwise(x, box: RowBox):
    """Everything in `x` in its rows, which `box` has one entry for."""
    return jax.tree.map(lambda y: in_rows(y, box.sides.shape[0]), x)


def _shortened(
    first: Forms, u: Array, v: Array, ds: Array, dt: Array, settled: Array, box: Sides
) -> tuple[Array, Array]:
    """The step within its bounds, and no longer than it does any good."""
    ds, dt = jnp.clip(ds, -LONGEST_STEP, LONGEST_STEP), jnp.clip(dt, -LONGEST_STEP, LONGEST_STEP)
    ds, dt = within(box, u, v, ds, dt)
    along = first.gradient_s * ds + first.gradient_t * dt
    length2 = first.E * ds * ds + 2.0 * first.F * ds * dt + first.G * dt * dt
    shortest = jnp.maximum(along, 0.0) / jnp.where(length2 > 0, length2, 1.0)
    share = jnp.where(settled, 0.0, jnp.where(2.0 * along >= length2, 1.0, shortest))
    return share * ds, share * dt
