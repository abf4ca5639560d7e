"""The collocation matrix N of a grid with a parameter pair for every point: (N P)_ij = R(u_ij, v_ij).

A row of N holds the K x L basis functions that do not vanish at its point. Where the net has one control
point for each data point, feet of interior points stay close to their control points: N then reaches no
farther than K - 2 rows and L - 2 columns from the diagonal, and N P is a stencil without a gather.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._splines._pieces import Axis

UNROLL = 16  # terms of a sum in one iteration of a loop


class PointCollocation(eqx.Module):
    """The rows of N: the number of the first basis function along u and along v, and the values of all."""

    first_u: Int[Array, "nu nv"]
    first_v: Int[Array, "nu nv"]
    basis_u: Float[Array, "K nu nv"]
    basis_v: Float[Array, "L nu nv"]

    @property
    def offsets(self) -> tuple[Int[Array, "nu nv"], Int[Array, "nu nv"]]:
        """How far the window of each point begins behind its control point, plus order less 1."""
        (order_u, nu, nv), order_v = self.basis_u.shape, self.basis_v.shape[0]
        to_u, to_v = (k - 1 - np.arange(n, dtype=np.int32) for k, n in ((order_u, nu), (order_v, nv)))
        return self.first_u + to_u[:, None], self.first_v + to_v[None, :]

    def times(self, net: Float[Array, "d nu nv"]) -> Float[Array, "d nu nv"]:
        """R at every point."""
        return _window_sum(net, self.first_u, self.first_v, self.basis_u, self.basis_v)

    def own(self) -> tuple[Float[Array, "nu nv"], Float[Array, "nu nv"]]:
        """N_i(u_ij) and N_j(v_ij), zero outside their support."""
        each = zip(self.offsets, (self.basis_u, self.basis_v), strict=True)
        own_u, own_v = (_coefficients(offset, basis, [len(basis) - 1])[0] for offset, basis in each)
        return own_u, own_v

    def is_close(self) -> Bool[Array, ""]:
        """Whether the interior points are so close to their control points that the stencil is right."""
        close = []
        for offset, order in zip(self.offsets, (len(self.basis_u), len(self.basis_v)), strict=True):
            inner, skipped = offset[1:-1, 1:-1], _skipped(order)
            close.append(jnp.all((inner >= skipped) & (inner < order - skipped)))
        return close[0] & close[1]

    def times_close(self) -> Any:
        """`times` as a function, if `is_close()`: the interior by the stencil, the border by gathers."""
        stencil = tuple(
            _coefficients(
                offset, basis, range(_skipped(len(basis)), 2 * len(basis) - 1 - _skipped(len(basis)))
            )
            for offset, basis in zip(self.offsets, (self.basis_u, self.basis_v), strict=True)
        )
        nu, nv = self.first_u.shape
        on_border = np.ones((nu, nv), bool)
        on_border[1:-1, 1:-1] = False
        i, j = np.nonzero(on_border)
        border = [x[i, j] for x in (self.first_u, self.first_v)]
        border += [x[:, i, j] for x in (self.basis_u, self.basis_v)]

        def times(net: Float[Array, "d nu nv"]) -> Float[Array, "d nu nv"]:
            return _shifted_sum(net, *stencil).at[:, i, j].set(_window_sum(net, *border))

        return times


def point_collocation(
    axes: tuple[Axis, Axis], u: Float[Array, "nu nv"], v: Float[Array, "nu nv"]
) -> PointCollocation:
    """The rows of N at the parameters of every point."""
    first_u, basis_u = basis_at(axes[0], u)
    first_v, basis_v = basis_at(axes[1], v)
    return PointCollocation(first_u, first_v, basis_u, basis_v)


def basis_at(axis: Axis, u: Float[Array, "..."]) -> tuple[Int[Array, "..."], Float[Array, "K ..."]]:
    """Number of the first non-zero function (that of the cell) and the values of all K."""
    cell = axis.locate(u)
    centre, half = (at_cells(x, cell) for x in (axis.centre, axis.half))
    s = ((u - centre) / half)[None]
    power = at_cells(jnp.asarray(axis.polynomials).T, cell)
    value = power[-1]
    for k in reversed(range(len(power) - 1)):
        value = value * s + power[k]
    return cell, value


def at_cells(table: Any, cell: Int[Array, "*points"]) -> Float[Array, "..."]:
    """Entries of a table along its last axis."""
    return jnp.asarray(table).at[..., cell].get(mode="promise_in_bounds")


def control_point_windows(
    net: Float[Array, "d nu nv"], first_u: Array, first_v: Array, order_u: int, order_v: int
) -> Float[Array, "d K L *points"]:
    """The K x L control points from (first_u, first_v) on, for every point."""
    dimensions = lax.GatherDimensionNumbers((0, 1, 2), (), (1, 2))
    first = jnp.stack([first_u, first_v], axis=-1)
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.gather(net, first, dimensions, (len(net), order_u, order_v), mode=mode)


def _window_sum(net: Array, first_u: Array, first_v: Array, basis_u: Array, basis_v: Array) -> Array:
    """R at the points whose control points begin at (first_u, first_v), one term of all points after the
    other: in loops a gather of whole windows takes twenty times as long.
    """
    d, nu, nv = net.shape
    (order_u, *points), order_v = basis_u.shape, len(basis_v)
    flat, first = net.reshape(d, nu * nv), first_u * nv + first_v
    weights = (basis_u[:, None] * basis_v[None]).reshape(order_u * order_v, 1, *points)
    shifts = (nv * np.arange(order_u)[:, None] + np.arange(order_v)[None, :]).reshape(-1).astype(np.int32)

    def add(total: Any, term: Any) -> tuple[Any, None]:
        shift, weight = term
        return total + weight * flat.at[:, first + shift].get(mode="promise_in_bounds"), None

    return lax.scan(add, jnp.zeros((d, *points), net.dtype), (shifts, weights), unroll=UNROLL)[0]


def _skipped(order: int) -> int:
    """How many of the K windows that hold a control point's own function the stencil does without, at either
    end."""
    return 1 if order > 2 else 0


def _coefficients(offset: Array, basis: Array, shifts: Any) -> Float[Array, "shifts nu nv"]:
    """Of the control points `shift` - (K - 1) places on, for each shift; zero where there is none."""
    number = np.asarray(shifts, np.int32)[:, None] - np.arange(len(basis), dtype=np.int32)[None, :]
    is_there = offset[None, None] == number[..., None, None]
    return jnp.sum(jnp.where(is_there, basis[None], 0.0), axis=1)


def _shifted_sum(net: Array, along_u: Array, along_v: Array) -> Array:
    """A sum of shifted copies of the net, each times its coefficients."""
    (shifts_u, nu, nv), shifts_v = along_u.shape, along_v.shape[0]
    half_u, half_v = shifts_u // 2, shifts_v // 2
    wide = jnp.pad(net, ((0, 0), (half_u, half_u), (half_v, half_v)))
    along_v = jnp.broadcast_to(along_v[:, None], (shifts_v, *net.shape))
    columns, total = [along_v[b] for b in range(shifts_v)], jnp.zeros_like(net)
    for a in range(shifts_u):
        rows: Any = 0.0
        for b, column in enumerate(columns):
            rows = rows + column * lax.slice(wide, (0, a, b), (len(net), a + nu, b + nv))
        total = total + along_u[a][None] * rows
    return total
