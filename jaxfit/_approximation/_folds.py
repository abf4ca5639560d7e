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
    samples = samples.reshape(*samples.shape[:4], pieces.axis_u.cells, pieces.axis_v.cells)
    area = _facing(samples, samples)
    # Where tangents are parallel or vanish, at poles and in cells without width, this is rounding.
    rounding = jnp.finfo(area.dtype).eps * jnp.max(area)
    size = jnp.sqrt(jnp.maximum(area, 0.0))

    def folded(axis: int) -> Float[Array, "1 1 m n a b"]:
        """Between a sample and the next one along u or v, in its cell or the next cell."""

        def following(x: Array) -> Array:
            inside, cells = x.ndim - 4 + axis, x.ndim - 2 + axis
            count = x.shape[cells]
            first, last = (lax.slice_in_dim(x, k, k + 1, axis=inside) for k in (0, SAMPLES - 1))
            after = [lax.slice_in_dim(first, 1, count, axis=cells)]
            after += [lax.slice_in_dim(last, count - 1, count, axis=cells)]
            here = lax.slice_in_dim(x, 1, SAMPLES, axis=inside)
            return jnp.concatenate([here, jnp.concatenate(after, cells)], inside)

        turned = _facing(samples, following(samples)) + rounding < COSINE * size * following(size)
        return turned.astype(size.dtype)

    return jnp.sum(folded(0) + folded(1), axis=(0, 1, 2, 3))


def _tangents(pieces: Pieces, direction: int) -> Float[Array, "d m n cells"]:
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
    return jnp.einsum("ma,danc->dmnc", tables[0], along_v)


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
