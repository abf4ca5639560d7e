"""`KnotInsertion`: knots inserted while a fit runs.

Control points and knots live in arrays of fixed size. Behind the last control point in use lie surplus ones,
and behind the knots as many repeats of the last knot; neither has any influence on the surface. So a fit
that refines its net is one compiled loop, and runs under `vmap`.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._checks import check_kind, check_number
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._splines._pieces import Axis, make_axis


class KnotInsertion(eqx.Module):
    """Inserts a knot into the worst span of u, and one into that of v, every few iterations (section 4.1).

    The worst span is the one whose points have the greatest sum of errors. The knot is inserted in its
    middle. The refinement is exact: the surface does not change.

    Parameters
    ----------
    every : int
        Iterations from one insertion to the next (default 40).
    most : int
        The largest number of insertions in a fit (default 16). The net has room for all of them, or for as
        many as `max_steps` permits, from the beginning. More room makes a fit slower.

    Raises
    ------
    ValueError
        If `every` is no whole number of at least 1, or `most` none of at least 0.

    Examples
    --------
    >>> jf.GeometricApproximation(insertion=jf.KnotInsertion(every=20)).insertion
    KnotInsertion(every=20)
    """

    every: int = 40
    most: int = 16

    def __check_init__(self) -> None:
        check_number("every", self.every, 1, whole=True)
        check_number("most", self.most, 0, whole=True)

    def __call__(
        self,
        step: Array,
        surface: WorkingSurface,
        projection: FootPoints,
        counted: Bool[Array, " points"],
    ) -> WorkingSurface:
        """The surface after iteration `step`, refined if it is time by the errors of `counted` points."""
        error = jnp.where(counted, projection.error, 0.0)
        return lax.cond(
            step % self.every == 0,
            lambda: insert_in_worst_spans(surface, projection.u, projection.v, error),
            lambda: surface,
        )


def room_for(insertion: KnotInsertion | None, surface: WorkingSurface, max_steps: Any) -> WorkingSurface:
    """The surface with room for all knots that may be inserted within `max_steps` iterations."""
    if insertion is None:
        return surface
    room = min(insertion.most, int(max_steps) // insertion.every)
    return surface.padded(room, room)


def check_insertion(insertion: Any) -> None:
    """Raise unless `insertion` is a KnotInsertion, or None for none."""
    check_kind("insertion", insertion, KnotInsertion | None, "KnotInsertion()")


def insert_in_worst_spans(surface: WorkingSurface, u: Array, v: Array, error: Array) -> WorkingSurface:
    """The surface with one more knot in the worst span of u and of v, while there is room."""
    net, knots_u, axis_u = _insert_in_worst_span(
        surface.control_points, surface.knots_u, surface.axis_u, u, error
    )
    transposed = jnp.swapaxes(net, 0, 1)
    transposed, knots_v, axis_v = _insert_in_worst_span(transposed, surface.knots_v, surface.axis_v, v, error)
    return WorkingSurface(jnp.swapaxes(transposed, 0, 1), knots_u, knots_v, axis_u, axis_v)


def _insert_in_worst_span(
    net: Float[Array, "n m d"], knots: Float[Array, " knots"], axis: Axis, u: Array, error: Array
) -> tuple[Float[Array, "n m d"], Float[Array, " knots"], Axis]:
    """Net, knots and axis with one more knot along the first direction."""
    count, order = net.shape[0], axis.polynomials.shape[1]
    total = jax.ops.segment_sum(error, axis.locate(u), axis.cells)
    span = jnp.argmax(total)
    low, high = axis.breaks[span], axis.breaks[span + 1]
    middle = 0.5 * (low + high)
    # A span so narrow that its middle is one of its ends cannot be cut.
    possible = (axis.used < count) & (middle > low) & (middle < high)
    # Boehm: a new control point divides the leg before it as the knot divides the support.
    near, far = knots[:count], knots[order - 1 : order - 1 + count]
    width = far - near
    share = jnp.where(width > 0, (middle - near) / jnp.where(width > 0, width, 1.0), middle >= far)
    share = jnp.clip(share, 0.0, 1.0)[:, None, None]
    before = jnp.concatenate([net[:1], net[:-1]])
    moved = share * net + (1.0 - share) * before
    more = jnp.sort(jnp.append(knots, middle))[:-1]
    net, knots = jnp.where(possible, moved, net), jnp.where(possible, more, knots)
    # New knots make no creases.
    return net, knots, dataclasses.replace(make_axis(knots, order), creased=axis.creased)
