"""The normal matrix of a spline fit as a stencil on the net: sixteen numbers for each control point.

Basis functions overlap their neighbours only, so the matrix couples a control point with those at most K - 1
rows and L - 1 columns away. Every matrix here is a sum of tensor products of symmetric ones, whatever the
data: sum_k w_k N_i N_i' (u_k) N_j N_j' (v_k) does not change where i and i' change places and j and j' do
not. So of the (2K - 1) x (2L - 1) neighbours one quadrant is enough.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._splines._pieces import Numbers


class Stencil(eqx.Module):
    """A symmetric matrix on a net of nu x nv control points.

    `entries[a, b, i, j]` stands between the control points (i, j) and (i + a, j + b), and likewise between
    (i + a, j) and (i, j + b); it is 0 where these lie outside the net.
    """

    entries: Float[Numbers, "K L nu nv"]

    @property
    def diagonal(self) -> Float[Numbers, "nu nv"]:
        """What couples every control point with itself."""
        return self.entries[0, 0]

    def __call__(self, net: Float[Numbers, "nu nv c"]) -> Float[Array, "nu nv c"]:
        """The matrix times a net, every coordinate for itself: shifted copies, no gather."""
        order_u, order_v, nu, nv = self.entries.shape
        reach_u, reach_v = order_u - 1, order_v - 1
        sides = ((0, 0), (reach_u, reach_u), (reach_v, reach_v))
        wide = jnp.pad(jnp.moveaxis(jnp.asarray(net), 2, 0), sides)
        entries = jnp.pad(self.entries, ((0, 0), (0, 0), (reach_u, 0), (reach_v, 0)))
        total: Any = 0.0
        for a in range(-reach_u, reach_u + 1):
            rows = wide[:, reach_u + a : reach_u + a + nu]
            first = reach_u + min(a, 0)
            for b in range(-reach_v, reach_v + 1):
                column = reach_v + min(b, 0)
                entry = entries[abs(a), abs(b), first : first + nu, column : column + nv]
                total = total + entry[None] * rows[:, :, reach_v + b : reach_v + b + nv]
        return jnp.moveaxis(total, 0, 2)

    def plus(self, other: "Stencil", factor: Any) -> "Stencil":
        """The sum of this and `factor` times the other."""
        return Stencil(self.entries + factor * other.entries)

    def transposed(self) -> "Stencil":
        """The same matrix on the net with its directions exchanged."""
        return Stencil(self.entries.transpose(1, 0, 3, 2))

    def dense(self) -> Float[Array, "n n"]:
        """All entries, control points numbered row by row; for small nets and for tests."""
        _, _, nu, nv = self.entries.shape
        unit = jnp.eye(nu * nv, dtype=self.entries.dtype).reshape(nu, nv, nu * nv)
        return self(unit).reshape(nu * nv, nu * nv)


def product(along_u: Float[Numbers, "K nu"], along_v: Float[Numbers, "L nv"]) -> Float[Numbers, "K L nu nv"]:
    """Entries of a tensor product of banded symmetric matrices, given as `band[a, i]` = entry (i, i + a)."""
    return along_u[:, None, :, None] * along_v[None, :, None, :]


def overlapped(terms: list[Any], count: int, axis: int) -> Any:
    """The sum of the terms, each one place farther along `axis` and padded there to `count` places."""
    xp: Any = np if isinstance(terms[0], np.ndarray) else jnp
    total: Any = 0.0
    for place, x in enumerate(terms):
        after = count - place - x.shape[axis]
        sides = [(place, after) if k == axis % x.ndim else (0, 0) for k in range(x.ndim)]
        total = total + xp.pad(x, sides)
    return total
