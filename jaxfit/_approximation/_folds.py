"""Where a surface folds during a fit: neighbouring samples whose normals turn away from one another."""

from functools import reduce
from operator import add, mul
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
    samples = jnp.stack([_tangents(pieces, 0), _tangents(pieces, 1)])
    size = jnp.sqrt(jnp.maximum(_facing(samples, samples), 0.0))

    def number(axis: int) -> Float[Array, "a b"]:
        """Folds between neighbours along u or v, the last of a cell and the first of the next included."""

        def neighbours(x: Array) -> tuple[Array, ...]:
            inside, cells = x.ndim - 4 + axis, x.ndim - 2 + axis
            first, last = (lax.slice_in_dim(x, k, k + 1, axis=inside) for k in (0, SAMPLES - 1))
            count = x.shape[cells]
            after = (
                lax.slice_in_dim(first, 1, count, axis=cells),
                lax.slice_in_dim(last, count - 1, count, axis=cells),
            )
            wide = lax.concatenate([x, lax.concatenate(after, cells)], inside)
            return tuple(lax.slice_in_dim(wide, k, k + SAMPLES, axis=inside) for k in (0, 1))

        here, there = neighbours(samples)
        turned = _facing(here, there) < COSINE * reduce(mul, neighbours(size))
        return jnp.sum(turned.astype(size.dtype), axis=(0, 1, 2, 3))

    return number(0) + number(1)


def _tangents(pieces: Pieces, direction: int) -> Float[Array, "d m n cells_u cells_v"]:
    """Tangents at samples (m, n) of all cells, in local coordinates: their length does not matter."""
    s = np.linspace(-1.0, 1.0, SAMPLES)
    tables: list[Any] = []
    for axis, order in enumerate(pieces.order):
        power = np.arange(order)
        table = s[:, None] ** power
        if axis == direction:
            table = power * s[:, None] ** np.maximum(power - 1, 0)
        tables.append(jnp.asarray(table, pieces.coefficients.dtype))
    # Cells come last, so that loops are long.
    along_v = jnp.einsum("nb,cdab->danc", tables[1], pieces.coefficients)
    at = jnp.einsum("ma,danc->dmnc", tables[0], along_v)
    return at.reshape(*at.shape[:3], pieces.axis_u.cells, pieces.axis_v.cells)


def _facing(
    here: Float[Array, "2 d m n a b"], there: Float[Array, "2 d m n a b"]
) -> Float[Array, "1 1 m n a b"]:
    """The product of two normals, by Lagrange's identity, which holds in every dimension."""

    def products(x: Array, y: Array) -> Array:
        # Written out: a reduction of so few numbers takes ten times as long on a CPU.
        both = reduce(add, lax.split(x * y, (1,) * x.shape[1], 1))
        return reduce(mul, lax.split(both, (1, 1), 0))

    return products(here, there) - products(here, jnp.flip(there, 0))


def near_folds(folds: Float[Array, "cells_u cells_v"], order: tuple[int, int]) -> Bool[Array, "nu nv"]:
    """The control points that influence a cell with folds, and their neighbours."""
    window, sides = tuple(k + 2 for k in order), [(k, k) for k in order]
    return lax.reduce_window(folds, jnp.zeros((), folds.dtype), lax.max, window, (1, 1), sides) > 0
