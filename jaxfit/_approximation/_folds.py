"""Folds of a surface during a fit: neighbouring samples whose normals face away from one another."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._splines._pieces import Pieces

SAMPLES = 5  # a cell and direction
COSINE = 0.2


def folded_cells(pieces: Pieces) -> Float[Array, "cells_u cells_v"]:
    """How many pairs of neighbouring samples are folds, in each cell."""
    order_u, order_v = pieces.order
    cells = pieces.axis_u.cells, pieces.axis_v.cells
    s = (2.0 * np.arange(SAMPLES) + 1.0) / SAMPLES - 1.0
    value, slope = ([_monomials(s, n, d) for n in (order_u, order_v)] for d in (0, 1))
    c = jnp.asarray(pieces.coefficients)
    dtype = c.dtype
    tangents = []
    for x, y in ((slope[0], value[1]), (value[0], slope[1])):
        at = jnp.einsum("cdab,ma,nb->dcmn", c, jnp.asarray(x, dtype), jnp.asarray(y, dtype))
        at = at.reshape(-1, *cells, SAMPLES, SAMPLES).transpose(0, 1, 3, 2, 4)
        tangents.append(at.reshape(-1, cells[0] * SAMPLES, cells[1] * SAMPLES))
    su, sv = tangents

    def facing(here: Any, there: Any) -> Array:
        """The product of the normals, by Lagrange's identity."""
        (a, b), (x, y) = here, there
        return _dot(a, x) * _dot(b, y) - _dot(a, y) * _dot(b, x)

    area = facing((su, sv), (su, sv))
    size = jnp.sqrt(jnp.maximum(area, 0.0))
    along_u = facing((su[:, 1:], sv[:, 1:]), (su[:, :-1], sv[:, :-1])) < COSINE * size[1:] * size[:-1]
    along_v = facing((su[:, :, 1:], sv[:, :, 1:]), (su[:, :, :-1], sv[:, :, :-1])) < COSINE * size[:, 1:] * size[:, :-1]
    folds = jnp.pad(along_u, ((0, 1), (0, 0))).astype(dtype) + jnp.pad(along_v, ((0, 0), (0, 1))).astype(dtype)
    return jnp.sum(folds.reshape(cells[0], SAMPLES, cells[1], SAMPLES), axis=(1, 3))


def _monomials(s: Any, order: int, derivative: int) -> Any:
    a = np.arange(order)
    if derivative:
        return np.where(a > 0, a * s[:, None] ** np.maximum(a - 1, 0), 0.0)
    return s[:, None] ** a


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=0)


def spread_to_net(cells: Float[Array, "cells_u cells_v"], order: tuple[int, int]) -> Float[Array, "nu nv"]:
    """The largest of the cells that a control point influences."""
    k, m = order
    return lax.reduce_window(cells, 0.0, lax.max, (k, m), (1, 1), ((k - 1, k - 1), (m - 1, m - 1)))
