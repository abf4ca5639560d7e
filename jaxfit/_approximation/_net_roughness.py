r"""Relative second differences of a control net."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxfit._normal_equations import Stencil


class Differences(eqx.Module):
    """`first[k, i]` and `second[k, i]`: weights of the control points i - 1, i, i + 1; 0 at both ends."""

    along_u: Any
    along_v: Any
    gaps_u: Any
    gaps_v: Any

    @staticmethod
    def of(greville_u: Any, greville_v: Any) -> "Differences":
        return Differences(_weights(greville_u), _weights(greville_v), _gaps(greville_u), _gaps(greville_v))

    def relative(self, net: Float[Array, "nu nv d"]) -> tuple[Array, Array]:
        """1 / |first differences|^2, for both directions"""
        turned = net.transpose(1, 0, 2)
        wu, wv = (_inverse_square(w[0], x, net) for w, x in ((self.along_u, net), (self.along_v, turned)))
        return wu, wv, MIXED * _corner_mean(wu + wv.T)

    def energies(self, net):
        turned = net.transpose(1, 0, 2)
        a = jnp.sum(_differences(self.along_u[1], net) ** 2, -1)
        b = jnp.sum(_differences(self.along_v[1], turned) ** 2, -1)
        return a, b, jnp.sum(self.mixed(net) ** 2, -1)

    def mixed(self, net):
        x = self.gaps_u[:, None, None] * jnp.diff(net, axis=0)
        return self.gaps_v[None, :, None] * jnp.diff(x, axis=1)


def _inverse_square(weights, x, net):
    square = jnp.sum(_differences(weights, x) ** 2, -1)
    n = square.size
    mean = jnp.sum(square) / n
    return 1.0 / jnp.maximum(square, 1e-4 * mean) + UNIFORM / mean


MIXED = 1.0
UNIFORM = 0.1


def _corner_mean(x):
    return 0.25 * (x[1:, 1:] + x[1:, :-1] + x[:-1, 1:] + x[:-1, :-1])


def _gaps(places):
    gaps = jnp.diff(places)
    share = 1.0 / (places.shape[0] - 1)
    return jnp.where(gaps > 1e-3 * share, jnp.sqrt(share / jnp.where(gaps > 0, gaps, 1.0)), 0.0)


def _weights(places: Any) -> Any:
    gaps = jnp.diff(places)
    share = 1.0 / (places.shape[0] - 1)
    inverse = jnp.where(gaps > 1e-3 * share, share / jnp.where(gaps > 0, gaps, 1.0), 0.0)
    before, after = inverse[:-1], inverse[1:]
    around = jnp.sqrt(2.0 * share / jnp.where(gaps[:-1] + gaps[1:] > 0, gaps[:-1] + gaps[1:], 1.0))
    around = jnp.where((before > 0) & (after > 0), around, 0.0)
    second = around * jnp.stack([before, -before - after, after])
    first = 0.5 * jnp.stack([-before, before - after, after])
    zero = jnp.zeros_like(inverse[:1])
    ends = [jnp.stack([zero, -inverse[:1], inverse[:1]]), jnp.stack([-inverse[-1:], inverse[-1:], zero])]
    first = jnp.concatenate([ends[0], first, ends[1]], axis=1)
    return jnp.stack([first, jnp.pad(second, ((0, 0), (1, 1)))])


def _differences(weights: Any, net: Array) -> Array:
    wide = jnp.pad(net, ((1, 1), (0, 0), (0, 0)))
    count = net.shape[0]
    return sum(weights[k][:, None, None] * wide[k : k + count] for k in range(3))


def stencil_of(differences: Differences, weight_u: Array, weight_v: Array, mixed: Array, order: tuple[int, int]) -> Stencil:
    """weights: (nu, nv) and (nv, nu)"""
    along_u = _bands(differences.along_u[1], weight_u)  # 3 nu nv
    along_v = jnp.swapaxes(_bands(differences.along_v[1], weight_v), 1, 2)
    entries = jnp.zeros((*order, *weight_u.shape), weight_u.dtype)
    entries = entries.at[:3, 0].set(along_u)
    entries = entries.at[0, :3].add(along_v)
    m = jnp.pad(mixed * (differences.gaps_u[:, None] * differences.gaps_v[None, :]) ** 2, 1)
    here, up, left, both = m[1:, 1:], m[:-1, 1:], m[1:, :-1], m[:-1, :-1]
    entries = entries.at[0, 0].add(here + up + left + both).at[1, 0].add(-here - left)
    entries = entries.at[0, 1].add(-here - up).at[1, 1].add(here)
    return Stencil(entries)


def _bands(weights: Any, x: Array) -> Array:
    """`[a, i, j]` between i and i + a."""
    count = x.shape[0]
    bands = []
    for a in range(3):
        total = 0.0
        for k in range(3 - a):  # the point i is the k-th of the difference at i + 1 - k
            at = jnp.pad(weights[k] * weights[k + a], (1, 1))[:, None] * jnp.pad(x, ((1, 1), (0, 0)))
            total = total + at[2 - k : 2 - k + count]
        bands.append(total)
    return jnp.stack(bands)
