r"""The simplified thin plate, equation (10) of the paper, as a stencil and as a sum of squares.

$$F_s = \int_0^1\!\!\int_0^1 |R_{uu}|^2 + 2 |R_{uv}|^2 + |R_{vv}|^2 \, du\, dv$$

is, in the control points, a sum of three tensor products of one-dimensional matrices
$\int N_i^{(d)} N_{i'}^{(d)}$, d = 0, 1, 2. Each is integrated by Gauss's rule with as many points as make it
exact, so that every matrix is $B_d^T B_d$ with one row of $B_d$ for a Gauss point. The domain is taken to be
$[0, 1]^2$ whatever the knots.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells import horner
from jaxfit._normal_equations._stencil import Stencil, overlapped, product
from jaxfit._splines._pieces import Axis, Numbers

# R_uu, sqrt(2) R_uv and R_vv: orders of the derivatives along u and v, and the factor.
TERMS = ((2, 0, 1.0), (1, 1, 2.0**0.5), (0, 2, 1.0))

Part = Float[Array, "_ _ _"]  # coordinates, Gauss points along u, along v
Bending = tuple[Part, Part, Part]


Root = Float[Numbers, "_ _ _"]  # Gauss points, cells, order
Roots = tuple[Root, Root, Root]


class ThinPlate(eqx.Module):
    """Square roots of the one-dimensional matrices: `roots[d][g, span, r]`, empty spans being zero."""

    roots_u: Roots
    roots_v: Roots

    def stencil(self) -> Stencil:
        """The matrix A_fair of (11)."""
        u0, u1, u2 = (_gram(root) for root in self.roots_u)
        v0, v1, v2 = (_gram(root) for root in self.roots_v)
        return Stencil(product(u2, v0) + 2.0 * product(u1, v1) + product(u0, v2))

    def residual(self, net: Float[Array, "nu nv c"]) -> Bending:
        """L P, whose sum of squares is F_s: the three second derivatives at Gauss points, weighted."""
        x = jnp.moveaxis(net, 2, 0)
        parts = [
            _applied(self.roots_v[e], _applied(factor * self.roots_u[d], x, -2), -1) for d, e, factor in TERMS
        ]
        return parts[0], parts[1], parts[2]

    def energy(self, net: Float[Array, "nu nv c"]) -> Float[Array, ""]:
        """F_s itself."""
        return sum(jnp.sum(x**2) for x in self.residual(net))  # type: ignore[return-value]

    def adjoint(self, residual: Bending) -> Float[Array, "nu nv c"]:
        """L^T times such values; of L P the gradient of F_s / 2."""
        total: Any = 0.0
        for (d, e, factor), x in zip(TERMS, residual, strict=True):
            total = total + _spread(factor * self.roots_u[d], _spread(self.roots_v[e], x, -1), -2)
        return jnp.moveaxis(total, 0, 2)


def thin_plate(axis_u: Axis, axis_v: Axis) -> ThinPlate:
    """The thin plate on the cells of a surface; knots may be traced."""
    return ThinPlate(_roots(axis_u), _roots(axis_v))


def _roots(axis: Axis) -> Any:
    """Derivatives of the basis functions at Gauss points, times the roots of the weights."""
    order = int(np.shape(axis.polynomials)[1])
    breaks = jnp.asarray(axis.breaks)
    width = (breaks[1:] - breaks[:-1]) / (breaks[-1] - breaks[0])
    filled = width > 0
    half = jnp.where(filled, 0.5 * width, 1.0)
    coefficients = jnp.moveaxis(jnp.asarray(axis.polynomials), 2, 0)
    roots = []
    for d in range(3):
        count = max(order - d, 1)  # exact for the square of a polynomial of degree order - 1 - d
        points, weights = np.polynomial.legendre.leggauss(count)
        scale = jnp.where(filled, half ** (0.5 - d), 0.0)[:, None]
        rows = [
            np.sqrt(w) * scale * horner(list(coefficients), jnp.asarray(x, half.dtype), d)
            for x, w in zip(points.tolist(), weights.tolist(), strict=True)
        ]
        roots.append(jnp.stack(rows))
    return tuple(roots)


def _gram(root: Float[Numbers, "g cells K"]) -> Float[Array, "K n"]:
    """The matrix as a band, entry (i, i + e) at `[e, i]`."""
    _, cells, order = root.shape
    bands = []
    for e in range(order):
        pairs = [jnp.sum(root[:, :, r] * root[:, :, r + e], axis=0) for r in range(order - e)]
        bands.append(overlapped(pairs, cells + order - 1, 0))
    return jnp.stack(bands)


def _applied(root: Float[Numbers, "g cells K"], x: Array, axis: int) -> Array:
    """B times `x` along an axis, -1 or -2; there the Gauss points of all cells, one kind after the other."""
    count, cells, order = root.shape
    rows = _beside(root, axis)
    kinds = []
    for g in range(count):
        terms: list[Any] = [rows[g, r] * lax.slice_in_dim(x, r, r + cells, axis=axis) for r in range(order)]
        kinds.append(sum(terms[1:], terms[0]))
    return jnp.concatenate(kinds, axis=axis)


def _spread(root: Float[Numbers, "g cells K"], y: Array, axis: int) -> Array:
    """B^T times `y` along an axis."""
    count, cells, order = root.shape
    rows = _beside(root, axis)
    kinds = [lax.slice_in_dim(y, g * cells, (g + 1) * cells, axis=axis) for g in range(count)]
    terms: list[Any] = [sum(rows[g, r] * x for g, x in enumerate(kinds)) for r in range(order)]
    return overlapped(terms, cells + order - 1, axis)


def _beside(root: Root, axis: int) -> Array:
    """Ready to broadcast along `axis`, -1 or -2, of three: `[g, r]` holds the values for all cells."""
    count, cells, order = root.shape
    rows = jnp.moveaxis(jnp.asarray(root), 2, 1)
    return rows.reshape(count, order, 1, 1, cells) if axis == -1 else rows.reshape(count, order, 1, cells, 1)
