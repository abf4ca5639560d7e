"""The collocation system of a grid at given parameters: every point's own few basis functions.

For a net with one control point for each data point, (N P)_ij = R(u_ij, v_ij). Feet of interior points stay
close to their control points, so that there N reaches no farther than K - 2 rows and L - 2 columns from them,
and N P is a fixed stencil: a sum of shifted copies of the net, each times an array of coefficients, with no
gather. The border's few points fetch their own.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._cells import horner
from jaxfit._splines._pieces import Axis


class Windows(eqx.Module):
    """Non-zero basis functions of every grid point: the first one's number, and the values of all."""

    first_u: Int[Array, "nu nv"]
    first_v: Int[Array, "nu nv"]
    basis_u: Float[Array, "K nu nv"]
    basis_v: Float[Array, "L nu nv"]

    @property
    def offset_u(self) -> Int[Array, "nu nv"]:
        """Which of its K functions is the control point's own, counted from the last; 0 to K - 1 if any."""
        number = jnp.arange(self.first_u.shape[0], dtype=jnp.int32)[:, None]
        return self.first_u - number + self.basis_u.shape[0] - 1

    @property
    def offset_v(self) -> Int[Array, "nu nv"]:
        """As `offset_u`."""
        number = jnp.arange(self.first_v.shape[1], dtype=jnp.int32)[None, :]
        return self.first_v - number + self.basis_v.shape[0] - 1

    def is_close(self) -> Bool[Array, ""]:
        """Whether the interior feet are so close to their control points that the stencil is right."""
        parts = ((self.offset_u, self.basis_u.shape[0]), (self.offset_v, self.basis_v.shape[0]))
        inside = [
            jnp.all((offset >= margin(order)) & (offset < order - margin(order)))
            for offset, order in ((offset[1:-1, 1:-1], order) for offset, order in parts)
        ]
        return inside[0] & inside[1]

    def part(self, rows: Any, columns: Any) -> "Windows":
        """Those of some of the points, given as slices."""
        first_u, first_v = (x[rows, columns] for x in (self.first_u, self.first_v))
        return Windows(first_u, first_v, self.basis_u[:, rows, columns], self.basis_v[:, rows, columns])

    def own(self) -> tuple[Float[Array, "nu nv"], Float[Array, "nu nv"]]:
        """N_i(u_ij) and N_j(v_ij), zero outside their support."""
        parts = ((self.offset_u, self.basis_u), (self.offset_v, self.basis_v))
        own_u, own_v = (_coefficient(offset, basis, basis.shape[0] - 1) for offset, basis in parts)
        return own_u, own_v


def _coefficient(offset: Array, basis: Array, shift: int) -> Array:
    """Of the control point `shift` - (K - 1) places on; zero where it is not in the window."""
    terms = [jnp.where(offset + r == shift, x, 0.0) for r, x in enumerate(basis)]
    return sum(terms[1:], terms[0])


def windows_at(axes: tuple[Axis, Axis], u: Float[Array, "nu nv"], v: Float[Array, "nu nv"]) -> Windows:
    """The basis functions at the parameters of every grid point."""
    first_u, basis_u = basis_at(axes[0], u)
    first_v, basis_v = basis_at(axes[1], v)
    return Windows(first_u, first_v, basis_u, basis_v)


def basis_at(axis: Axis, u: Float[Array, "..."]) -> tuple[Int[Array, "..."], Float[Array, "K ..."]]:
    """Number of the first non-zero function (that of the cell) and the values of all K."""
    cell = axis.locate(u)
    order = axis.polynomials.shape[1]
    s = (u - axis.centre[cell]) / axis.half[cell]
    flat, first = jnp.asarray(axis.polynomials).reshape(-1), cell * order**2
    number = np.arange(order**2).reshape(order, order)
    values = [horner([flat[first + int(i)] for i in row], s, 0) for row in number]
    return cell, jnp.stack(values)


def margin(order: int) -> int:
    """How many of the K windows that hold a control point's own function the stencil does without, either
    side."""
    return 1 if order > 2 else 0


class Stencil(eqx.Module):
    """N as shifts of the net, with coefficients for the shifts of -r ... r rows and of -s ... s columns."""

    along_u: Float[Array, "shifts_u nu nv"]
    along_v: Float[Array, "shifts_v nu nv"]

    def __call__(self, net: Float[Array, "d nu nv"]) -> Float[Array, "d nu nv"]:
        """R at every foot."""
        (shifts_u, nu, nv), shifts_v = self.along_u.shape, self.along_v.shape[0]
        half_u, half_v = shifts_u // 2, shifts_v // 2
        wide = jnp.pad(net, ((0, 0), (half_u, half_u), (half_v, half_v)))
        total: Any = 0.0
        for a in range(shifts_u):
            rows = wide[:, a : a + nu]
            row: Any = sum(self.along_v[b][None] * rows[:, :, b : b + nv] for b in range(shifts_v))
            total = total + self.along_u[a][None] * row
        return total


def stencil_of(windows: Windows) -> Stencil:
    """The stencil; right only for interior points, and where `windows.is_close()`."""
    return Stencil(_shifted(windows.offset_u, windows.basis_u), _shifted(windows.offset_v, windows.basis_v))


def _shifted(offset: Array, basis: Array) -> Array:
    least = margin(basis.shape[0])
    shifts = range(least, 2 * basis.shape[0] - 1 - least)
    return jnp.stack([_coefficient(offset, basis, shift) for shift in shifts])


def applied(windows: Windows, stencil: Stencil, net: Float[Array, "d nu nv"]) -> Float[Array, "d nu nv"]:
    """R at every foot: the interior by the stencil, the border's points one by one."""
    inner = slice(1, -1)
    values = stencil(net)
    for end in (slice(0, 1), slice(-1, None)):
        values = values.at[:, end].set(gathered(windows.part(end, slice(None)), net))
        values = values.at[:, inner, end].set(gathered(windows.part(inner, end), net))
    return values


def gathered(windows: Windows, net: Float[Array, "d nu nv"]) -> Float[Array, "d rows columns"]:
    """R at every foot of the windows, wherever it is: each fetches its own control points."""
    d, _, nv = net.shape
    first = windows.first_u * nv + windows.first_v
    values = []
    for k in range(d):
        flat = net[k].reshape(-1)
        rows: list[Any] = [
            sum(basis * flat[first + (r * nv + q)] for q, basis in enumerate(windows.basis_v))
            for r in range(windows.basis_u.shape[0])
        ]
        values.append(sum(basis * row for basis, row in zip(windows.basis_u, rows, strict=True)))
    return jnp.stack(values)
