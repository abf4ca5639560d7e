r"""Normal matrices that couple the coordinates, as stencils on the net.

Rows of least-squares problems that measure a residual in some directions only, with a matrix $\Pi_k$ for
each point, have the normal matrix $\sum_k N_i N_j N_{i'} N_{j'} \Pi_k$. Each entry of $\Pi$ is a weight of
its own, so this is one stencil for every pair of coordinates, from the same moments.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._normal_equations._normal_matrix import entries_of_moments
from jaxfit._normal_equations._stencil import ShiftedProducts, Stencil
from jaxfit._splines._pieces import Axis, Numbers


class CoupledStencil(eqx.Module):
    """A symmetric matrix on nets of nu x nv control points with coordinates.

    `entries[p, q]` is the stencil between the coordinates p and q.
    """

    entries: Float[Numbers, "d d K L nu nv"]

    @property
    def blocks(self) -> Float[Array, "nu nv d d"]:
        """What couples the coordinates of every control point with one another."""
        return jnp.moveaxis(self.entries[:, :, 0, 0], (0, 1), (2, 3))

    @property
    def trace(self) -> Stencil:
        """The sum over all coordinates with themselves."""
        diagonal = [self.entries[p, p] for p in range(self.entries.shape[0])]
        return Stencil(sum(diagonal[1:], diagonal[0]))

    def at_fixed_parameters(self, damping: Any) -> Stencil:
        """Of rows blended by mu, `damping`, with those at fixed parameters, the matrix of the latter.

        The trace has 1 + (d - 1) mu times that: of a point's d directions one is a normal.
        """
        return Stencil(self.trace.entries / (1.0 + (self.entries.shape[0] - 1) * damping))

    def plus(self, other: Stencil) -> "CoupledStencil":
        """With an uncoupled matrix added."""
        unit = jnp.eye(self.entries.shape[0], dtype=self.entries.dtype)[:, :, None, None, None, None]
        return CoupledStencil(self.entries + unit * other.entries[None, None])

    def with_directions_swapped(self) -> "CoupledStencil":
        """The same matrix on the net with its directions exchanged."""
        return CoupledStencil(self.entries.transpose(0, 1, 3, 2, 5, 4))

    def __call__(self, net: Float[Numbers, "nu nv d"]) -> Float[Array, "nu nv d"]:
        """The matrix times a net."""
        return jnp.moveaxis(self.product()(jnp.moveaxis(jnp.asarray(net), 2, 0)), 0, 2)

    def product(self) -> Callable[[Float[Array, "d nu nv"]], Float[Array, "d nu nv"]]:
        """The product with nets that have their coordinates first, to be taken many times."""
        products = ShiftedProducts.of(self.entries)
        return lambda net: products(net[:, None])

    def dense(self) -> Float[Array, "n n"]:
        """All entries, the coordinates running fastest; for small nets and for tests."""
        d, _, _, _, nu, nv = self.entries.shape
        unit = jnp.eye(nu * nv * d, dtype=self.entries.dtype).reshape(-1, nu, nv, d)
        return jax.vmap(self)(unit).reshape(nu * nv * d, nu * nv * d)


def coupled_stencil(
    moments: Float[Array, "cells A Bp"], axis_u: Axis, axis_v: Axis, d: int
) -> CoupledStencil:
    """From the cells' moments of the entries of Pi_k on and above the diagonal, as `row_moments` has them."""
    pairs = np.zeros((d, d), int)
    pairs[np.triu_indices(d)] = np.arange(d * (d + 1) // 2)
    entries = entries_of_moments(moments.reshape(*moments.shape[:2], -1, d * (d + 1) // 2), axis_u, axis_v)
    return CoupledStencil(jnp.take(entries, np.maximum(pairs, pairs.T), axis=0, mode="clip"))
