"""The derivative of geometric interpolation in its data.

What the loop finds satisfies N(feet, knots) P = Q. Differentiated, this needs how the feet follow the
data. They moved in the first few iterations only; a derivative replays these, differentiably.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._closest import as_feet, project
from jaxfit._fit._border import corners
from jaxfit._fit._measure import FOOT_STEPS, side_bounds
from jaxfit._interpolation._collocation_systems import with_derivative
from jaxfit._interpolation._repositioning import lowest_eigenvalue
from jaxfit._interpolation._tensor_collocation import Windows
from jaxfit._splines._pieces import Axis, make_axis, pieces_on

NOISE = 1e3  # rounding units of the diagonal: a point so close counts as met
SHORT = 8  # moves: as many are remembered whole rather than made twice
RESTART = 20  # of GMRES; the system is well conditioned wherever the iteration converges

Pair = tuple[Any, Any]


class Setting(eqx.Module):
    """What a fit starts from, in the problem's unit."""

    data: Float[Any, "nu nv d"]
    knots: Pair
    averaged: Pair
    feet: Pair  # to start from, (nu, nv) each
    diagonal: Float[Any, ""]
    tolerance: Float[Any, ""]
    foot_tolerance: Float[Any, ""]


class Found(eqx.Module):
    """What a fit ends with."""

    net: Float[Array, "nu nv d"]
    u: Float[Array, "nu nv"]
    v: Float[Array, "nu nv"]


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def followed(method: Any, order: tuple[int, int], found: Found, setting: Setting) -> Found:
    """`found`, with the derivative in `setting` that the method's adjoint asks for."""
    return found


@followed.defjvp
def _followed_jvp(method: Any, order: tuple[int, int], primals: Any, tangents: Any) -> Any:
    found, setting = primals
    found = followed(method, order, found, setting)  # for derivatives of the derivative
    return jax.jvp(partial(_replayed, method, order, found), (setting,), tangents[1:])


@partial(jax.jit, static_argnums=(0, 1))
def _replayed(method: Any, order: tuple[int, int], found: Found, setting: Setting) -> Found:
    """`found` as a function of what the fit started from."""
    moves = method.adjoint.moves(method.freeze_after)
    if moves is None:
        u, v = found.u, found.v
        knots = lax.stop_gradient(setting.knots)
    else:
        feet = _feet_after(moves, method, order, setting)
        # The values are those of the fit, which may have looked for its feet again at the end.
        u, v = (x + (y - lax.stop_gradient(y)) for x, y in zip((found.u, found.v), feet, strict=True))
        knots = setting.knots
    net = with_derivative(order, RESTART, found.net, (u, v), knots, None, setting.data)
    return Found(net, u, v)


def _feet_after(moves: int, method: Any, order: tuple[int, int], setting: Setting) -> Pair:
    """The feet when the net has moved so often.

    First the values of all feet on the way, then the same way again with derivatives, which needs no search.
    """
    fixed = _Way(method, order, lax.stop_gradient(setting))
    begin = (fixed.net, fixed.feet)
    _, way = lax.scan(lambda x, _: fixed.leg(x, fixed.found(*x)), begin, None, length=moves + 1)
    with_tangents = _Way(method, order, setting)

    def again(x: tuple[Array, Pair], feet: Pair) -> tuple[tuple[Array, Pair], Pair]:
        return with_tangents.leg(x, with_tangents.as_feet(*x, feet))

    again = jax.checkpoint(again) if moves > SHORT else again
    (_, feet), _ = lax.scan(again, (with_tangents.net, with_tangents.feet), way)
    return feet


class _Way:
    """The iteration while feet move, as functions of net and feet."""

    def __init__(self, method: Any, order: tuple[int, int], setting: Setting):
        self.method, self.setting = method, setting
        self.net = jnp.asarray(setting.data)
        self.shape = (self.net.shape[0], self.net.shape[1])
        self.feet = (jnp.asarray(setting.feet[0]), jnp.asarray(setting.feet[1]))
        axes = (make_axis(x, k, simple=True) for x, k in zip(setting.knots, order, strict=True))
        self.axes: tuple[Axis, Axis] = (next(axes), next(axes))
        self.held = corners(self.shape[0], self.shape[1])
        self.within = side_bounds(self.axes, *self.shape) if method.keep_borders else None
        self.limit = setting.foot_tolerance * setting.diagonal
        self.lowest = jnp.ones((), self.net.dtype)
        if method.needs_spectrum:
            self.lowest = lowest_eigenvalue(self.axes, setting.averaged)

    def found(self, net: Array, feet: Pair) -> Pair:
        """Closest points from the last ones."""
        pieces = pieces_on(net, *self.axes)
        target = self.setting.data.reshape(-1, net.shape[2]).T
        u, v = (x.reshape(-1) for x in feet)
        steps, idle = jnp.asarray(FOOT_STEPS, jnp.int32), jnp.asarray(self.held.reshape(-1))
        how = self.method.foot_method
        new = project(how, pieces, target, u, v, self.limit, steps, idle, True, self.within)
        return new.best_u.reshape(self.shape), new.best_v.reshape(self.shape)

    def as_feet(self, net: Array, before: Pair, feet: Pair) -> Pair:
        """`feet`, which have been found, with derivatives.

        Where a point is met to rounding, its foot follows that before: which way it would move is noise.
        """
        points = self.setting.data.reshape(-1, net.shape[2])
        flat = (feet[0].reshape(-1), feet[1].reshape(-1))
        new = as_feet(flat, (net, *self.setting.knots), points, self.limit, self.within)
        square = jnp.sum(self.error(net, feet) ** 2, axis=0)
        noise = NOISE * jnp.finfo(net.dtype).eps * self.setting.diagonal
        still = self.held | (square <= noise**2)
        u, v = (
            jnp.where(still, y + (x - lax.stop_gradient(x)), z.reshape(self.shape))
            for x, y, z in zip(before, feet, new, strict=True)
        )
        return u, v

    def error(self, net: Array, feet: Pair) -> Array:
        """Q - R, (d, nu, nv)."""
        return jnp.moveaxis(self.setting.data - _values(self.windows(feet), net), -1, 0)

    def windows(self, feet: Pair) -> Windows:
        """The basis functions at the feet."""
        each = [_basis(axis, x) for axis, x in zip(self.axes, feet, strict=True)]
        (first_u, basis_u), (first_v, basis_v) = each
        return Windows(first_u, first_v, jnp.moveaxis(basis_u, -1, 0), jnp.moveaxis(basis_v, -1, 0))

    def leg(self, before: tuple[Array, Pair], feet: Pair) -> tuple[tuple[Array, Pair], Pair]:
        """One move of the net, its feet being known."""
        net, method = before[0], self.method
        e = self.error(net, feet)
        weight = method.repositioning.weights(self.windows(feet), self.lowest)
        met = jnp.sum(e**2, axis=0) <= (self.setting.tolerance * self.setting.diagonal) ** 2
        still = (self.held | met) if method.local else self.held
        shift = jnp.where(still[None], 0.0, weight[None] * e)
        move, _ = method.acceleration.step(shift, method.acceleration.init(shift, weight, self.lowest))
        return (net + jnp.moveaxis(move, 0, -1), feet), feet


# As in `_collocation`, but in few large operations: derivatives of many small ones take long to compile.


def _basis(axis: Axis, u: Array) -> tuple[Array, Array]:
    """Number of the first non-zero basis function, and the values of all K, (nu, nv, K)."""
    cell = axis.locate(u)
    polynomials = jnp.asarray(axis.polynomials)[cell]
    s = ((u - jnp.asarray(axis.centre)[cell]) / jnp.asarray(axis.half)[cell])[..., None]
    value = polynomials[..., -1]
    for k in reversed(range(polynomials.shape[-1] - 1)):
        value = value * s + polynomials[..., k]
    return cell, value


def _values(windows: Windows, net: Array) -> Array:
    """R at every foot, (nu, nv, d)."""
    order_u, order_v = windows.basis_u.shape[0], windows.basis_v.shape[0]
    rows = windows.first_u[..., None] + jnp.arange(order_u)[None, None]
    columns = windows.first_v[..., None] + jnp.arange(order_v)[None, None]
    points = net[rows[..., :, None], columns[..., None, :]]
    weights = jnp.moveaxis(windows.basis_u[:, None] * windows.basis_v[None], (0, 1), (2, 3))
    return jnp.sum(weights[..., None] * points, axis=(2, 3))
