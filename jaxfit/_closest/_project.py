"""From starting parameters to converged feet: the kernel every closest point and every fit calls."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._closest._blocks import finish
from jaxfit._closest._feet import Feet, new_feet
from jaxfit._closest._steps import AbstractFootMethod
from jaxfit._closest._sweep import sweep
from jaxfit._splines._pieces import Pieces

# Below this many points, or points per cell, rows are too empty to pay.
ROWS_FROM_POINTS = 4096
ROWS_FROM_FILL = 2


def project(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    tolerance: Array,
    max_steps: Array,
    idle: Bool[Array, " points"] | None = None,
    borders: bool = True,
) -> Feet:
    """Foot points of `target` on the surface, from the starts (u, v); `idle` points stay where
    they are. With `borders`, feet that do not converge are looked for on the four border curves.

    The coordinates must be small against nothing but their own extent (centre them first): rounding is
    judged by their largest magnitude.
    """
    points = target.shape[1]
    noise = 4.0 * jnp.finfo(target.dtype).eps * jnp.max(jnp.abs(target))
    tolerance = jnp.maximum(jnp.asarray(tolerance, target.dtype), 4.0 * noise)
    axes = (pieces.axis_u, pieces.axis_v)
    u, v = (jnp.clip(x, a.breaks[0], a.breaks[-1]) for x, a in zip((u, v), axes, strict=True))
    idle = jnp.zeros(points, bool) if idle is None else idle
    if points >= ROWS_FROM_POINTS and points >= ROWS_FROM_FILL * pieces.cells:
        feet = sweep(method, pieces, target, u, v, idle, tolerance, noise)
    else:
        feet = new_feet(u, v)
    feet = feet.marked(feet.done | idle, feet.converged | idle)
    return finish(method, pieces, target, feet, tolerance, noise, max_steps, borders)
