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
        return jnp.moveaxis(ShiftedProducts.of(self.entries[None, None])(channels), 0, 2)

    def plus(self, other: "Stencil") -> "Stencil":
        """The sum of both."""
        return Stencil(self.entries + other.entries)

    def times(self, factor: Any) -> "Stencil":
        """The matrix times a number."""
        return Stencil(factor * self.entries)

    def with_directions_swapped(self) -> "Stencil":
        """The same matrix on the net with its directions exchanged."""
        return Stencil(self.entries.transpose(1, 0, 3, 2))

    def dense(self) -> Float[Array, "n n"]:
        """All entries, control points numbered row by row; for small nets and for tests."""
        _, _, nu, nv = self.entries.shape
        unit = jnp.eye(nu * nv, dtype=self.entries.dtype).reshape(nu, nv, nu * nv)
        return self(unit).reshape(nu * nv, nu * nv)


class ShiftedProducts(eqx.Module):
    r"""$x \mapsto \sum_q E_q x_q$ over all neighbours, with stencils $E_{pq}$, to be applied many times.

    The rows of the net lie end to end with zeros between them, so that every neighbour is a fixed number of
    places away, and a product with one shift is plain vector arithmetic.
    """

    entries: Float[Array, "K L q p places"]
    shape: tuple[int, int] = eqx.field(static=True)

    @staticmethod
    def of(entries: Float[Numbers, "p q K L nu nv"]) -> "ShiftedProducts":
        """Of the stencils `entries[p, q]`."""
        p, q, order_u, order_v, nu, nv = entries.shape
        # Products go to both sides, and a shift by 0 counts twice.
        once = [np.where(np.arange(order) == 0, 0.5, 1.0) for order in (order_u, order_v)]
        share = (once[0][:, None] * once[1])[None, None, :, :, None, None].astype(entries.dtype)
        lines = jnp.pad(entries * share, ((0, 0),) * 5 + ((0, order_v - 1),))
        lines = lines.reshape(p, q, order_u, order_v, -1)
        before = _reach(order_u, order_v, nv)
        return ShiftedProducts(
            jnp.pad(lines, ((0, 0),) * 4 + ((before, 0),)).transpose(2, 3, 1, 0, 4), (nu, nv)
        )

    def __call__(self, x: Float[Array, "q r nu nv"]) -> Float[Array, "s nu nv"]:
        """p or r is 1, and s the other.

        One loop over the shifts (a, b) forward, each with its four signs. Written out it would be 49 products
        for bicubic splines, which take half a second to compile. The total is carried along: to store each
        step's sum and add them at the end takes a CPU several times as long on large nets.
        """
        order_u, order_v, q, p, _ = self.entries.shape
        (nu, nv), count = self.shape, x.shape[1]
        width, reach = nv + order_v - 1, _reach(order_u, order_v, nv)
        places = nu * width
        lines = jnp.pad(x, ((0, 0),) * 3 + ((0, order_v - 1),)).reshape(q, count, places)
        lines = jnp.pad(lines, ((0, 0), (0, 0), (reach, reach)))
        a, b = np.indices((order_u, order_v), np.int32).reshape(2, -1)
        signs = [(sign_a, sign_b) for sign_a in (1, -1) for sign_b in (1, -1)]
        # An entry is stored at the first of its two rows and the first of its two columns.
        stored = [reach - (i < 0) * a * width - (j < 0) * b for i, j in signs]
        neighbours = [reach + i * a * width + j * b for i, j in signs]
        zero = np.int32(0)

        def part_of(array: Array, start: tuple[Any, ...], channels: int) -> Array:
            before = range(array.ndim - 2)
            size = (*(1 for _ in before), channels, places)
            part = lax.dynamic_slice(
                array, (*start[:-1], zero, start[-1]), size, allow_negative_indices=False
            )
            return lax.squeeze(part, before)

        def products(total: Array, at: Any) -> tuple[Array, None]:
            a, b, stored, neighbours = at
            for here, there in zip(stored, neighbours, strict=True):
                for number in map(np.int32, range(q)):
                    entries = part_of(self.entries, (a, b, number, here), p)
                    total += entries * part_of(lines, (number, there), count)
            return total, None

        dtype = jnp.result_type(self.entries, x)
        begin = as_varying(jnp.zeros((max(p, count), places), dtype), self.entries, x)
        total, _ = lax.scan(products, begin, (a, b, stored, neighbours))
        return total.reshape(-1, nu, width)[:, :, :nv]


def _reach(order_u: int, order_v: int, nv: int) -> int:
    """How many places away the farthest neighbour is."""
    return (order_u - 1) * (nv + order_v - 1) + order_v - 1


def shifted_slices(x: Any, count: int, size: int, axis: int) -> Any:
    """`size` entries along `axis` from each of the first `count` places, along a new first axis."""
    if isinstance(x, np.ndarray):
        return np.stack([np.take(x, range(r, r + size), axis) for r in range(count)])
    return jnp.stack([lax.slice_in_dim(x, r, r + size, axis=axis) for r in range(count)])
