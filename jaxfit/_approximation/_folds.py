"""Where a surface folds during a fit: neighbouring samples whose normals turn away from one another."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._splines._pieces import Pieces

# So many samples in each cell and direction, both ends included. Between neighbours normals may turn by 60
# degrees, which is 90 degrees within a fifth of a cell.
SAMPLES, COSINE = 8, 0.5


def folds_by_cell(pieces: Pieces) -> Float[Array, "cells_u cells_v"]:
    """The number of folds that begin in each cell. Places without a normal count as none."""
    along = [_tangents(pieces, derivative) for derivative in (0, 1)]
    size = jnp.sqrt(jnp.maximum(_facing(along, along), 0.0))

    def folded(axis: int) -> Float[Array, "a b"]:
        def but(first: bool, x: Array) -> Array:
            n = x.shape[axis - 2]
            return lax.slice_in_dim(x, *((1, n) if first else (0, n - 1)), axis=x.ndim + axis - 2)

        here, there = ([but(first, x) for x in along] for first in (False, True))
        turned = _facing(here, there) < COSINE * but(False, size) * but(True, size)
        return jnp.pad(turned, [(0, int(k == axis)) for k in range(2)]).astype(size.dtype)

    number = folded(0) + folded(1)
    cells_u, cells_v = pieces.axis_u.cells, pieces.axis_v.cells
    return jnp.sum(number.reshape(cells_u, SAMPLES, cells_v, SAMPLES), axis=(1, 3))


def _tangents(pieces: Pieces, direction: int) -> Float[Array, "d a b"]:
    """Tangents on all samples, in local coordinates: their length does not matter."""
    s = np.linspace(-1.0, 1.0, SAMPLES)
    tables: list[Any] = []
    for axis, order in enumerate(pieces.order):
        power = np.arange(order)
        table = s[:, None] ** power
        if axis == direction:
            table = power * s[:, None] ** np.maximum(power - 1, 0)
        tables.append(jnp.asarray(table, pieces.coefficients.dtype))
    at = jnp.einsum("cdab,ma,nb->dcmn", pieces.coefficients, *tables)
    cells_u, cells_v = pieces.axis_u.cells, pieces.axis_v.cells
    at = at.reshape(-1, cells_u, cells_v, SAMPLES, SAMPLES).transpose(0, 1, 3, 2, 4)
    return at.reshape(-1, cells_u * SAMPLES, cells_v * SAMPLES)


def _facing(here: list[Array], there: list[Array]) -> Float[Array, "a b"]:
    """The product of two normals, by Lagrange's identity, which holds in every dimension."""
    (a, b), (x, y) = here, there
    return jnp.sum(a * x, 0) * jnp.sum(b * y, 0) - jnp.sum(a * y, 0) * jnp.sum(b * x, 0)


def near_folds(folds: Float[Array, "cells_u cells_v"], order: tuple[int, int]) -> Bool[Array, "nu nv"]:
    """The control points that influence a cell with folds, and their neighbours."""
    window, sides = tuple(k + 2 for k in order), [(k, k) for k in order]
    return lax.reduce_window(folds, jnp.zeros((), folds.dtype), lax.max, window, (1, 1), sides) > 0
