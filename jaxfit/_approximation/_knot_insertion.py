"""Knots inserted while a fit runs: nets and knot vectors with room to grow.

Control points and knots live in arrays of fixed size. Behind the last control point in use lie surplus ones,
and behind the knots as many repeats of the last knot; neither has any influence on the surface. So a fit
that refines its net is one compiled loop, and runs under `vmap`.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._checks import check_kind, check_number
from jaxfit._splines._pieces import Axis, make_axis


class KnotInsertion(eqx.Module):
    """Every so many iterations a knot in the worst span of u and one in the worst span of v (section 4.1).

    The worst span is the one whose points have the greatest sum of errors, along u and along v each; the
    knot goes into its middle. The refinement is exact: the surface is the same before and after.

    Parameters
    ----------
    every : int
        Iterations from one insertion to the next (default 40).
    most : int
        Most insertions in a fit (default 16). The net has room for so many from the beginning, or for as many
        as `max_steps` permits, and a fit takes the longer, the more room.
    """

    every: int = 40
    most: int = 16

    def __check_init__(self) -> None:
        check_number("every", self.every, 1, whole=True)
        check_number("most", self.most, 0, whole=True)

    def __call__(
        self, step: Array, net: Array, growth: "Growth", measured: Any, real: Any
    ) -> tuple[Array, "Growth"]:
        """The net after iteration `step`, refined if it is time; of the points only `real` ones count."""
        error = jnp.where(real, measured.error, 0.0)
        return lax.cond(
            step % self.every == 0,
            lambda: refined(net, growth, measured.u, measured.v, error),
            lambda: (net, growth),
        )

    def room(self, max_steps: int) -> int:
        """Control points to be added along either direction at most."""
        return min(self.most, max_steps // self.every)


def check_insertion(insertion: Any) -> None:
    """When there are new knots, or None for never."""
    if insertion is not None:
        check_kind("insertion", insertion, KnotInsertion, "KnotInsertion()")


class Growth(eqx.Module):
    """The knots of a net with room for more, and what follows from them."""

    knots_u: Float[Any, " knots_u"]
    knots_v: Float[Any, " knots_v"]
    axis_u: Axis
    axis_v: Axis

    @property
    def axes(self) -> tuple[Axis, Axis]:
        """Both directions."""
        return self.axis_u, self.axis_v


def with_room(net: Any, knots: tuple[Any, Any], axes: tuple[Axis, Axis], room: int) -> tuple[Any, Growth]:
    """A net and its knots with `room` surplus control points in each direction."""
    grown = []
    for index, (knot, axis) in enumerate(zip(knots, axes, strict=True)):
        order = axis.polynomials.shape[1]
        xp: Any = np if isinstance(knot, np.ndarray) else jnp
        knot = xp.concatenate([knot, xp.repeat(knot[-1:], room)])
        grown += [(knot, _axis(knot, order, axis.creased or order == 2))]
        net = jnp.concatenate(
            [net, jnp.repeat(lax.slice_in_dim(net, -1, None, axis=index), room, index)], index
        )
    (knots_u, axis_u), (knots_v, axis_v) = grown
    return net, Growth(knots_u, knots_v, axis_u, axis_v)


def _axis(knots: Any, order: int, creased: bool) -> Axis:
    """The axis of refined knots: new knots make no creases."""
    return dataclasses.replace(make_axis(knots, order), creased=creased)


def refined(
    net: Float[Array, "nu nv d"], growth: Growth, u: Array, v: Array, error: Array
) -> tuple[Float[Array, "nu nv d"], Growth]:
    """A knot more in the worst span of either direction, while there is room."""
    net, knots_u, axis_u = _refined(net, growth.knots_u, growth.axis_u, u, error)
    turned = jnp.swapaxes(net, 0, 1)
    turned, knots_v, axis_v = _refined(turned, growth.knots_v, growth.axis_v, v, error)
    return jnp.swapaxes(turned, 0, 1), Growth(knots_u, knots_v, axis_u, axis_v)


def _refined(
    net: Float[Array, "n m d"], knots: Float[Array, " knots"], axis: Axis, u: Array, error: Array
) -> tuple[Float[Array, "n m d"], Float[Array, " knots"], Axis]:
    """Along the first axis."""
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
    return net, knots, _axis(knots, order, axis.creased)


def cut(net: Any, growth: Growth) -> tuple[Any, Any, Any]:
    """Control points and both knot vectors in use, as NumPy arrays (concrete)."""
    (axis_u, axis_v), (knots_u, knots_v) = growth.axes, (growth.knots_u, growth.knots_v)
    used = [int(axis.used) for axis in (axis_u, axis_v)]
    ends = [n + axis.polynomials.shape[1] for n, axis in zip(used, (axis_u, axis_v), strict=True)]
    return (
        np.asarray(net)[: used[0], : used[1]],
        np.asarray(knots_u)[: ends[0]],
        np.asarray(knots_v)[: ends[1]],
    )
