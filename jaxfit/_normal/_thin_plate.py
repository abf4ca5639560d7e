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
from jax import Array
from jaxtyping import Float

from jaxfit._cells import horner
from jaxfit._normal._stencil import Stencil, overlapped, product
from jaxfit._splines._pieces import Axis, Numbers


class ThinPlate(eqx.Module):
    """Square roots of the one-dimensional matrices: `roots[d][g, span, r]`, empty spans being zero."""

    roots_u: tuple[Float[Numbers, "g0 cells_u K"], Float[Numbers, "g1 cells_u K"], Float[Numbers, "g2 cells_u K"]]
    roots_v: tuple[Float[Numbers, "h0 cells_v L"], Float[Numbers, "h1 cells_v L"], Float[Numbers, "h2 cells_v L"]]

    def stencil(self) -> Stencil:
        """The matrix A_fair of (11)."""
        u0, u1, u2 = (_gram(root) for root in self.roots_u)
        v0, v1, v2 = (_gram(root) for root in self.roots_v)
        return Stencil(product(u2, v0) + 2.0 * product(u1, v1) + product(u0, v2))

    def residual(self, net: Float[Array, "nu nv c"]) -> tuple[Array, Array, Array]:
        """L P, whose sum of squares is F_s: the three second derivatives at Gauss points, weighted."""
        parts = []
        for d, factor in ((2, 1.0), (1, 2.0**0.5), (0, 1.0)):
            half = _applied(self.roots_u[d], net)
            whole = _applied(self.roots_v[2 - d], jnp.moveaxis(half, -2, 0))
            parts.append(factor * whole.reshape(-1, net.shape[2]))
        return parts[0], parts[1], parts[2]


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


def _applied(root: Float[Numbers, "g cells K"], x: Float[Array, "n ..."]) -> Float[Array, "g cells ..."]:
    """B times `x` along its first axis."""
    _, cells, order = root.shape
    rows = root.reshape(*root.shape, *(1,) * (x.ndim - 1))
    terms: list[Any] = [rows[:, :, r] * x[None, r : r + cells] for r in range(order)]
    return sum(terms[1:], terms[0])
