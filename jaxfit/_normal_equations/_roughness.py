r"""How unevenly a surface runs, relative to its own tangents, as a quadratic form on nets.

The unit normal of a surface with orthogonal parameter lines turns by

$$|n_u|^2 + |n_v|^2 = \frac{(n \cdot R_{uu})^2}{|R_u|^2}
  + (n \cdot R_{uv})^2 \Big(\frac1{|R_u|^2} + \frac1{|R_v|^2}\Big) + \frac{(n \cdot R_{vv})^2}{|R_v|^2}$$

for a step of the parameters, and its tangents turn and stretch likewise, by the tangential parts of the same
derivatives. So with whole second derivatives in place of their normal parts, this is how much the frame of a
surface changes. A fold is a place where it changes by 180 degrees within less than a cell. The thin plate
(10) does not see that: second derivatives are small where tangents are.

Here derivatives are differences of the net at Greville abscissae, with steps of the mean distance of
these: all terms are angles, whatever the size of the net and of the surface.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._checks import is_concrete
from jaxfit._normal_equations._penalty import AbstractPenalty
from jaxfit._normal_equations._stencil import Stencil
from jaxfit._splines._knots import greville
from jaxfit._splines._pieces import Numbers

# Squared tangents count as at least this share of their mean; and this share of what a mean tangent gives is
# added everywhere, so that wide cells are not left slack.
LEAST_SQUARE, UNIFORM_SHARE = 1e-4, 0.1
LEAST_GAP = 1e-3  # of the mean distance; control points closer than that have no difference


class _Differences(eqx.Module):
    """Along one direction: weights of the control points i - 1, i, i + 1 in the first and the second
    difference at i, and of i in the difference from i to i + 1. Second differences at the ends are 0.
    `present` is 1, and 0 for surplus control points.
    """

    present: Float[Numbers, " n"]

    first: Float[Numbers, "3 n"]
    second: Float[Numbers, "3 n"]
    step: Float[Numbers, " gaps"]


class NetSquares(eqx.Module):
    """A number for each second difference of a net: along u, mixed (at the corners between), along v."""

    uu: Float[Array, "nu nv"]
    uv: Float[Array, "mu mv"]
    vv: Float[Array, "nu nv"]


class Roughness(AbstractPenalty):
    """The quadratic form: the sum of `weights` times the squared second differences of a net."""

    along_u: _Differences
    along_v: _Differences
    weights: NetSquares
    order: tuple[int, int] = eqx.field(static=True)

    @staticmethod
    def of(
        net: Float[Array, "nu nv d"], knots_u: Any, knots_v: Any, factor: Float[Array, "nu nv"]
    ) -> "Roughness":
        """Relative to the tangents of `net`; `factor` is a further weight for each control point."""
        nu, nv = net.shape[:2]
        order = knots_u.shape[0] - nu, knots_v.shape[0] - nv
        along_u, along_v = (_differences(x, k) for x, k in zip((knots_u, knots_v), order, strict=True))
        present = jnp.asarray(along_u.present)[:, None] * jnp.asarray(along_v.present)[None, :]
        # So surplus control points have neither tangents nor second differences.
        factor, net = present * factor, present[:, :, None] * net
        per_u = _inverse_square(_apply(along_u.first, net))
        per_v = _inverse_square(_swap(_apply(along_v.first, _swap(net))))
        weights = NetSquares(factor * per_u, _at_corners(factor) * _at_corners(per_u + per_v), factor * per_v)
        return Roughness(along_u, along_v, weights, order)

    def energy(self, net: Float[Array, "nu nv d"]) -> Float[Array, ""]:
        """The form at a net."""
        turned = _swap(net)
        mixed = _stepped(self.along_v, _swap(_stepped(self.along_u, net)))
        parts = (
            (self.weights.uu, _apply(self.along_u.second, net)),
            (self.weights.uv, _swap(mixed)),
            (self.weights.vv, _swap(_apply(self.along_v.second, turned))),
        )
        return sum((jnp.sum(weight * jnp.sum(x**2, axis=-1)) for weight, x in parts), jnp.zeros(()))

    def system(self, net: Float[Array, "nu nv d"]) -> tuple[Stencil, Float[Array, "nu nv d"]]:
        """Its matrix, and this matrix times a net, half the gradient there."""
        stencil = self._stencil()
        return stencil, stencil(net)

    def _stencil(self) -> Stencil:
        order_u, order_v = self.order
        uu, vv = _bands(self.along_u.second, self.weights.uu), _bands(self.along_v.second, self.weights.vv.T)
        step = jnp.asarray(self.along_u.step)[:, None] * jnp.asarray(self.along_v.step)[None, :]
        mixed = jnp.pad(self.weights.uv * step**2, 1)
        here, above, left, both = mixed[1:, 1:], mixed[:-1, 1:], mixed[1:, :-1], mixed[:-1, :-1]
        entries = jnp.zeros((max(order_u, 3), max(order_v, 3), *uu.shape[1:]), uu.dtype)
        entries = entries.at[:3, 0].add(uu).at[0, :3].add(vv.transpose(0, 2, 1))
        entries = entries.at[0, 0].add(here + above + left + both).at[1, 1].add(here)
        entries = entries.at[1, 0].add(-here - left).at[0, 1].add(-here - above)
        return Stencil(entries[:order_u, :order_v])


def _differences(knots: Any, order: int) -> _Differences:
    """For the Greville abscissae of these knots; surplus control points have no differences."""
    places = greville(knots, order)
    xp: Any = np if is_concrete(knots) else jnp
    last, gaps = places[-1], places[1:] - places[:-1]
    mean = (last - places[0]) / xp.maximum(xp.sum(gaps > 0), 1)  # of those that are not surplus
    apart = gaps > LEAST_GAP * mean
    inverse = xp.where(apart, mean / xp.where(apart, gaps, 1.0), 0.0)
    before, after = inverse[:-1], inverse[1:]
    # The root of what the difference stands for, so that sums of squares are integrals.
    inside = apart[:-1] & apart[1:] & (order > 2)
    share = xp.sqrt(xp.where(inside, 2.0 * mean / xp.where(inside, gaps[:-1] + gaps[1:], 1.0), 0.0))
    second = xp.pad(share[None] * xp.stack([before, -before - after, after]), ((0, 0), (1, 1)))
    left, right = xp.pad(inverse, (1, 0)), xp.pad(inverse, (0, 1))
    sides = xp.maximum((left > 0).astype(places.dtype) + (right > 0), 1.0)
    first = xp.stack([-left, left - right, right]) / sides[None]
    present = xp.pad((places[:-1] < last).astype(places.dtype), (1, 0), constant_values=1.0)
    return _Differences(present, first, second, xp.sqrt(inverse))


def _apply(weights: Any, net: Float[Array, "n m d"]) -> Float[Array, "n m d"]:
    wide, count = jnp.pad(net, ((1, 1), (0, 0), (0, 0))), net.shape[0]
    parts = [jnp.asarray(weights[k])[:, None, None] * wide[k : k + count] for k in range(3)]
    return parts[0] + parts[1] + parts[2]


def _stepped(along: _Differences, net: Array) -> Array:
    return jnp.asarray(along.step)[:, None, None] * (net[1:] - net[:-1])


def _swap(net: Array) -> Array:
    return net.transpose(1, 0, 2)


def _inverse_square(tangents: Float[Array, "nu nv d"]) -> Float[Array, "nu nv"]:
    square = jnp.sum(tangents**2, axis=-1)
    mean = jnp.sum(square) / jnp.maximum(jnp.sum(square > 0), 1)
    mean = jnp.where(mean > 0, mean, 1.0)
    return 1.0 / jnp.maximum(square, LEAST_SQUARE * mean) + UNIFORM_SHARE / mean


def _at_corners(x: Float[Array, "n m"]) -> Float[Array, "k l"]:
    return 0.25 * (x[1:, 1:] + x[1:, :-1] + x[:-1, 1:] + x[:-1, :-1])


def _bands(weights: Any, factor: Float[Array, "n m"]) -> Float[Array, "3 n m"]:
    """Entries of the matrix of one direction, `[a, i]` between the control points i and i + a."""
    count, weights, bands = factor.shape[0], jnp.asarray(weights), []
    for a in range(3):
        # The control point i is the k-th of the difference at i + 1 - k.
        parts = [
            jnp.pad((weights[k] * weights[k + a])[:, None] * factor, ((1, 1), (0, 0)))[2 - k : 2 - k + count]
            for k in range(3 - a)
        ]
        bands.append(sum(parts[1:], parts[0]))
    return jnp.stack(bands)
