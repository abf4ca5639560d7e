"""`WorkingSurface`: the surface that a fit moves, with its knots prepared for evaluation."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxfit._checks import is_concrete
from jaxfit._splines._pieces import Axis, Pieces, make_axis, pieces_on


class WorkingSurface(eqx.Module):
    """Control points and knots in the unit of the problem, and both directions of the knots prepared.

    A surface that gets more knots during the fit has room for them: surplus control points after the last one
    in use, and as many repeats of the last knot. Neither has any influence.

    Attributes
    ----------
    control_points : array (nu, nv, d)
    knots_u : array (nu + K,)
    knots_v : array (nv + L,)
    axis_u, axis_v : Axis
        The knots of each direction, prepared for evaluation; made by `WorkingSurface.of`.

    Examples
    --------
    >>> net, knots_u = np.zeros((5, 3, 3)), jf.clamped_uniform_knots(5, 4)
    >>> surface = jf.WorkingSurface.of(net, np.asarray(knots_u), np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
    >>> surface.order, surface.used.tolist(), surface.padded(2, 1).control_points.shape
    ((4, 3), [5, 3], (7, 4, 3))
    """

    control_points: Float[Any, "nu nv d"]
    knots_u: Float[Any, " knots_u"]
    knots_v: Float[Any, " knots_v"]
    axis_u: Axis
    axis_v: Axis

    @staticmethod
    def of(control_points: Any, knots_u: Any, knots_v: Any, simple: bool = False) -> "WorkingSurface":
        """Prepare both axes; `simple` says that no interior knot repeats (see `make_axis`)."""
        nu, nv = control_points.shape[:2]
        axis_u = make_axis(knots_u, knots_u.shape[0] - nu, simple)
        axis_v = make_axis(knots_v, knots_v.shape[0] - nv, simple)
        return WorkingSurface(control_points, knots_u, knots_v, axis_u, axis_v)

    @property
    def axes(self) -> tuple[Axis, Axis]:
        """Both directions."""
        return self.axis_u, self.axis_v

    @property
    def order(self) -> tuple[int, int]:
        """Degree + 1 along u and v."""
        nu, nv = self.control_points.shape[:2]
        return self.knots_u.shape[0] - nu, self.knots_v.shape[0] - nv

    @property
    def pieces(self) -> Pieces:
        """Polynomial pieces, one for each cell."""
        return pieces_on(self.control_points, *self.axes)

    @property
    def used(self) -> Int[Any, "2"]:
        """How many control points have influence, along u and v."""
        xp: Any = np if is_concrete(self.axes) else jnp
        return xp.stack([xp.asarray(axis.used, np.int32) for axis in self.axes])

    def moved_to(self, control_points: Float[Any, "nu nv d"]) -> "WorkingSurface":
        """The surface with other control points and the same knots."""
        return dataclasses.replace(self, control_points=control_points)

    def padded(self, room_u: int, room_v: int) -> "WorkingSurface":
        """With so many surplus control points in each direction."""
        net = self.control_points
        xp: Any = np if is_concrete(net) else jnp
        net = xp.pad(net, ((0, room_u), (0, room_v), (0, 0)), mode="edge")
        knots = []
        for x, room in ((self.knots_u, room_u), (self.knots_v, room_v)):
            yp: Any = np if is_concrete(x) else jnp
            knots.append(yp.concatenate([x, yp.repeat(x[-1:], room)]))
        wide = WorkingSurface.of(net, *knots)
        creased = [a.creased or k == 2 for a, k in zip(self.axes, self.order, strict=True)]
        axes = [dataclasses.replace(a, creased=c) for a, c in zip(wide.axes, creased, strict=True)]
        return dataclasses.replace(wide, axis_u=axes[0], axis_v=axes[1])

    def trimmed(self) -> "WorkingSurface":
        """Without surplus control points and knots, as NumPy arrays (concrete)."""
        nu, nv = (int(x) for x in self.used)
        order_u, order_v = self.order
        net, knots_u, knots_v = (np.asarray(x) for x in (self.control_points, self.knots_u, self.knots_v))
        return WorkingSurface.of(net[:nu, :nv], knots_u[: nu + order_u], knots_v[: nv + order_v])


def plane(shape: tuple[int, int, int], order: tuple[int, int], dtype: Any) -> WorkingSurface:
    """A surface with a net of this shape, for what does not depend on the net."""
    at = [np.linspace(0, 1, n, dtype=dtype) for n in shape[:2]]
    net = np.zeros(shape, dtype)
    net[..., 0], net[..., 1] = at[0][:, None], at[1]
    breaks = [np.linspace(0, 1, n - k + 2, dtype=dtype) for n, k in zip(shape[:2], order, strict=True)]
    knots_u, knots_v = (np.pad(x, k - 1, "edge") for x, k in zip(breaks, order, strict=True))
    return WorkingSurface.of(net, knots_u, knots_v)
