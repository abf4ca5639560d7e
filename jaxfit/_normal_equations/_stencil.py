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
from jax import Array, lax
from jaxtyping import Float

from jaxfit._splines._pieces import Numbers
from jaxfit._varying import as_varying


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
        """The matrix times a net, every coordinate for itself."""
        channels = jnp.moveaxis(jnp.asarray(net), 2, 0)[None]
        return jnp.moveaxis(shifted_products(self.entries[None, None], channels), 0, 2)

    def plus(self, other: "Stencil") -> "Stencil":
        """The sum of both."""
        return Stencil(self.entries + other.entries)

    def times(self, factor: Any) -> "Stencil":
        """The matrix times a number."""
        return Stencil(factor * self.entries)

    def transposed(self) -> "Stencil":
        """The same matrix on the net with its directions exchanged."""
        return Stencil(self.entries.transpose(1, 0, 3, 2))

    def dense(self) -> Float[Array, "n n"]:
        """All entries, control points numbered row by row; for small nets and for tests."""
        _, _, nu, nv = self.entries.shape
        unit = jnp.eye(nu * nv, dtype=self.entries.dtype).reshape(nu, nv, nu * nv)
        return self(unit).reshape(nu * nv, nu * nv)


def shifted_products(
    entries: Float[Numbers, "p q K L nu nv"], x: Float[Array, "q r nu nv"]
) -> Float[Array, "s nu nv"]:
    r"""$\sum_q E_q x_q$ over all neighbours, with stencils $E_{pq}$; p or r is 1, and s the other.

    One loop over the shifts (a, b) and over q. Written out it would be 49 products for bicubic splines, which
    take half a second to compile and run hardly faster.
    """
    p, q, order_u, order_v, nu, nv = entries.shape
    reach_u, reach_v = order_u - 1, order_v - 1
    wide = jnp.pad(x, ((0, 0), (0, 0), (reach_u, reach_u), (reach_v, reach_v)))
    entries = jnp.pad(entries, ((0, 0),) * 4 + ((reach_u, 0), (reach_v, 0)))
    a, b, number = np.indices((2 * order_u - 1, 2 * order_v - 1, q), np.int32).reshape(3, -1)
    shift_u, shift_v = a - reach_u, b - reach_v
    # Entries of a neighbour before this control point are stored with the neighbour.
    stored = (number, abs(shift_u), abs(shift_v), np.minimum(a, reach_u), np.minimum(b, reach_v))
    zero = np.int32(0)

    def part_of(array: Array, start: tuple[Any, ...], size: tuple[int, ...]) -> Array:
        return lax.dynamic_slice(array, start, size, allow_negative_indices=False)

    def add(total: Array, at: Any) -> tuple[Array, None]:
        place, a, b = at
        entry = part_of(entries, (zero, *place), (p, 1, 1, 1, nu, nv))
        neighbour = part_of(wide, (place[0], zero, a, b), (1, x.shape[1], nu, nv))
        return total + lax.squeeze(entry, (1, 2, 3)) * lax.squeeze(neighbour, (0,)), None

    none = jnp.zeros((max(p, x.shape[1]), nu, nv), jnp.result_type(entries, x))
    return lax.scan(add, as_varying(none, entries, x), (stored, a, b))[0]


def shifted_slices(x: Any, count: int, size: int, axis: int) -> Any:
    """`size` entries along `axis` from each of the first `count` places, along a new first axis."""
    if isinstance(x, np.ndarray):
        return np.stack([np.take(x, range(r, r + size), axis) for r in range(count)])
    return jnp.stack([lax.slice_in_dim(x, r, r + size, axis=axis) for r in range(count)])
