r"""The simplified thin plate, equation (10) of the paper, as a stencil and as a sum of squares.

$$F_s = \int_0^1\!\!\int_0^1 |R_{uu}|^2 + 2 |R_{uv}|^2 + |R_{vv}|^2 \, du\, dv$$

is, in the control points, a sum of three tensor products of one-dimensional matrices
$\int N_i^{(d)} N_{i'}^{(d)}$, d = 0, 1, 2. Each is integrated by Gauss's rule with as many points as make it
exact, so that every matrix is $B_d^T B_d$ with one row of $B_d$ for a Gauss point. The domain is taken to be
$[0, 1]^2$ whatever the knots.
"""

import math
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._cells import overlap_add
from jaxfit._checks import is_concrete
from jaxfit._normal_equations._stencil import Stencil, shifted_slices
from jaxfit._splines._pieces import Axis, Numbers
from jaxfit._varying import as_varying

TERMS = np.sqrt([1.0, 2.0, 1.0])  # of R_vv, R_uv and R_uu, by the order of the derivative along u

Bending = Float[Array, "3 g cells_u h cells_v c"]


class ThinPlate(eqx.Module):
    """Square roots of the one-dimensional matrices: `roots[d, g, span, r]`, empty spans being zero.

    Of concrete knots they are NumPy arrays, constants that are known before anything is traced.
    """

    roots_u: Float[Numbers, "3 g cells_u K"]
    roots_v: Float[Numbers, "3 h cells_v L"]

    def stencil(self) -> Stencil:
        """The matrix A_fair of (11)."""
        along_u, along_v = _bands(self.roots_u), _bands(self.roots_v)[::-1]
        xp: Any = np if is_concrete(self) else jnp
        factor = xp.asarray(TERMS**2, along_u.dtype)[:, None, None]
        return Stencil(xp.einsum("dai,dbj->abij", factor * along_u, along_v))

    def residual(self, net: Float[Array, "nu nv c"]) -> Bending:
        """L P, whose sum of squares is F_s: the three second derivatives at Gauss points, weighted."""
        factor = jnp.asarray(TERMS, net.dtype)[:, None, None, None]
        (_, _, cells_u, order_u), (_, _, cells_v, order_v) = self.roots_u.shape, self.roots_v.shape
        x = shifted_slices(jnp.asarray(net), order_u, cells_u, 0)
        x = jnp.einsum("dgir,rijc->dgijc", factor * jnp.asarray(self.roots_u), x, precision="highest")
        x = shifted_slices(x, order_v, cells_v, 3)
        return jnp.einsum("dhjr,rdgijc->dgihjc", self.roots_v[::-1], x, precision="highest")

    def energy(self, net: Float[Array, "nu nv c"]) -> Float[Array, ""]:
        """F_s itself.

        As a sum of squares it is accurate to rounding. The product P . A P would lose digits, since the
        greatest eigenvalue of A far exceeds the energy of a smooth net: six digits for 60 x 60 points.
        """
        return jnp.sum(self.residual(net) ** 2)

    def adjoint(self, residual: Bending) -> Float[Array, "nu nv c"]:
        """L^T times such values; of L P the gradient of F_s / 2."""
        (nu, nv), c = self.shape, residual.shape[-1]
        # Of a net that is the same on all devices the transpose would be a sum over them.
        net, residual = as_varying((jnp.zeros((nu, nv, c), residual.dtype), residual), residual, self)
        return jax.linear_transpose(self.residual, net)(residual)[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the net."""
        sizes = (root.shape[2] + root.shape[3] - 1 for root in (self.roots_u, self.roots_v))
        return next(sizes), next(sizes)


def thin_plate(axis_u: Axis, axis_v: Axis) -> ThinPlate:
    """The thin plate on the cells of a surface; knots may be traced."""
    return ThinPlate(_roots(axis_u), _roots(axis_v))


def _roots(axis: Axis) -> Any:
    """Derivatives of the basis functions at Gauss points, times the roots of the weights."""
    xp: Any = np if is_concrete(axis) else jnp
    order, breaks = np.shape(axis.polynomials)[1], axis.breaks
    width = (breaks[1:] - breaks[:-1]) / (breaks[-1] - breaks[0])
    filled = width > 0
    half = xp.where(filled, 0.5 * width, 1.0)
    orders = xp.asarray([0.5, -0.5, -1.5], half.dtype)[:, None]
    scale = xp.where(filled[None], half[None] ** orders, 0.0)
    monomials = xp.asarray(_monomials(order), half.dtype)
    return xp.einsum("dga,ira,di->dgir", monomials, axis.polynomials, scale)


@cache
def _monomials(order: int) -> Float[np.ndarray, "3 g order"]:
    """Derivatives of s^a at Gauss points, times the roots of the weights."""
    points, weights = np.polynomial.legendre.leggauss(order)
    table = np.zeros((3, order, order))
    for d in range(3):
        for a in range(d, order):
            table[d, :, a] = np.sqrt(weights) * math.perm(a, d) * points ** (a - d)
    return table


def _bands(roots: Float[Numbers, "3 g cells K"]) -> Any:
    """The matrices as bands, entry (i, i + e) at `[d, e, i]`."""
    xp: Any = np if isinstance(roots, np.ndarray) else jnp
    order = roots.shape[3]
    neighbours = shifted_slices(xp.pad(roots, ((0, 0),) * 3 + ((0, order - 1),)), order, order, 3)
    return overlap_add(xp.einsum("dgir,edgir->rdei", roots, neighbours), -1)
