r"""The collocation system of a grid whose rows share $u_i$ and whose columns share $v_j$: a tensor product.

$\sum_{kl} N_k(u_i) N_l(v_j) P_{kl} = Q_{ij}$ falls apart into banded systems, one direction after the other.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxfit._splines import _banded as banded

Solver = Callable[[Array], Array]


class TensorCollocation(eqx.Module):
    """The bands of both directions. Nets and data are (n, m, d)."""

    band_u: Float[Array, "n band_u"]
    band_v: Float[Array, "m band_v"]

    def times(self, net: Float[Array, "n m d"]) -> Float[Array, "n m d"]:
        """The surface with this net at all parameters."""
        return banded.times(self.band_v, banded.times(self.band_u, net, axis=0), axis=1)

    def solve(self, data: Float[Array, "n m d"]) -> Float[Array, "n m d"]:
        """The net whose surface takes the values `data`."""
        return _both_ways(banded.solve, self.band_u, self.band_v, data)

    def factorised(self) -> Solver:
        """`solve` with the factors computed once, for loops; without derivatives."""
        factors = banded.factorise(self.band_u), banded.factorise(self.band_v)
        return lambda data: _both_ways(banded.substitute, *factors, data)

    def transposed(self) -> "TensorCollocation":
        """The transposed system."""
        return TensorCollocation(banded.transposed(self.band_u), banded.transposed(self.band_v))


def _both_ways(apply: Callable[[Any, Array], Array], matrix_u: Any, matrix_v: Any, x: Array) -> Array:
    n, m, d = x.shape
    x = apply(matrix_u, x.reshape(n, m * d)).reshape(n, m, d)
    x = apply(matrix_v, jnp.swapaxes(x, 0, 1).reshape(m, n * d)).reshape(m, n, d)
    return jnp.swapaxes(x, 0, 1)


def tensor_collocation(
    knots: tuple[Array, Array],
    order: tuple[int, int],
    u: Array,
    v: Array,
    derivatives: tuple[int, ...] = (0,),
) -> TensorCollocation:
    """The collocation matrices at the parameters `u` of the rows and `v` of the columns.

    `derivatives` are those of `collocation_band`.
    """
    bands = [banded.collocation_band(*each, derivatives) for each in zip(knots, order, (u, v), strict=True)]
    return TensorCollocation(*bands)
