r"""Normal matrices that couple the coordinates, as stencils on the net.

Rows of least-squares problems that measure a residual in some directions only, with a matrix $\Pi_k$ for
each point, have the normal matrix $\sum_k N_i N_j N_{i'} N_{j'} \Pi_k$. Each entry of $\Pi$ is a weight of
its own, so this is one stencil for every pair of coordinates, from the same moments.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._normal_equations._moments import basis_products
from jaxfit._normal_equations._stencil import Stencil, overlapped
from jaxfit._splines._pieces import Axis, Numbers


def pair_numbers(d: int) -> np.ndarray:
    """`[a, b]` is the number of the pair of coordinates {a, b}, counted row by row from (0, 0)."""
    number = np.zeros((d, d), int)
    rows, columns = np.triu_indices(d)
    number[rows, columns] = number[columns, rows] = np.arange(rows.size)
    return number


class CoupledStencil(eqx.Module):
    """A symmetric matrix on nets of nu x nv control points with coordinates.

    `entries[pair]` is the stencil between two coordinates, with pairs as numbered by `pair_numbers`.
    """

    entries: Float[Numbers, "pairs K L nu nv"]

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return (int((8 * self.entries.shape[0] + 1) ** 0.5) - 1) // 2

    @property
    def blocks(self) -> Float[Array, "nu nv d d"]:
        """What couples the coordinates of every control point with one another."""
        return jnp.moveaxis(self.entries[pair_numbers(self.dimension), 0, 0], (0, 1), (2, 3))

    @property
    def trace(self) -> Stencil:
        """The sum over all coordinates with themselves."""
        d = self.dimension
        number = pair_numbers(d)
        return Stencil(sum(self.entries[number[a, a]] for a in range(d)))  # type: ignore[arg-type]

    def plus(self, other: Stencil, factor: Any) -> "CoupledStencil":
        """With `factor` times an uncoupled matrix added."""
        d = self.dimension
        more = factor * other.entries
        number = pair_numbers(d)
        place = {number[a, a] for a in range(d)}
        parts = [x + more if k in place else x for k, x in enumerate(self.entries)]
        return CoupledStencil(jnp.stack(parts))

    def __call__(self, net: Float[Numbers, "nu nv d"]) -> Float[Array, "nu nv d"]:
        """The matrix times a net: shifted copies, no gather."""
        _, order_u, order_v, nu, nv = self.entries.shape
        number = pair_numbers(self.dimension)
        reach_u, reach_v = order_u - 1, order_v - 1
        wide = jnp.pad(jnp.moveaxis(jnp.asarray(net), 2, 0), ((0, 0), (reach_u,) * 2, (reach_v,) * 2))
        entries = jnp.pad(self.entries, ((0, 0), (0, 0), (0, 0), (reach_u, 0), (reach_v, 0)))
        totals: list[Any] = [0.0] * self.dimension
        for a in range(-reach_u, reach_u + 1):
            first = reach_u + min(a, 0)
            for b in range(-reach_v, reach_v + 1):
                column = reach_v + min(b, 0)
                entry = entries[:, abs(a), abs(b), first : first + nu, column : column + nv]
                x = wide[:, reach_u + a : reach_u + a + nu, reach_v + b : reach_v + b + nv]
                for row, pairs in enumerate(number):
                    totals[row] = totals[row] + sum(entry[p] * x[c] for c, p in enumerate(pairs))
        return jnp.stack(totals, axis=-1)

    def dense(self) -> Float[Array, "n n"]:
        """All entries, the coordinates running fastest; for small nets and for tests."""
        nu, nv = self.entries.shape[3:]
        size = nu * nv * self.dimension
        unit = jnp.eye(size, dtype=self.entries.dtype).reshape(size, nu, nv, self.dimension)
        return jax.vmap(self)(unit).reshape(size, size)


def coupled_stencil(
    moments: Float[Array, "cells A Bp"], axis_u: Axis, axis_v: Axis, pairs: int
) -> CoupledStencil:
    """From the cells' moments of the entries of Pi_k, (2K - 1) x (2L - 1) of each, as `row_moments` has them.

    One direction at a time: moments into entries for the basis functions of a span, then spans overlapped.
    """
    products_u, products_v = basis_products(axis_u), basis_products(axis_v)
    order_u, order_v = products_u.shape[1], products_v.shape[1]
    x = moments.reshape(axis_u.cells, axis_v.cells, 2 * order_u - 1, 2 * order_v - 1, pairs)
    along_v = jnp.einsum("qsfb,pqabc->scfapq", products_v, x, precision="highest")
    x = overlapped(list(along_v), axis_v.cells + order_v - 1, -1)
    along_u = jnp.einsum("prea,cfapj->rcefpj", products_u, x, precision="highest")
    return CoupledStencil(overlapped(list(along_u), axis_u.cells + order_u - 1, -2))
