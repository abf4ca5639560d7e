"""Rows laid over the pieces of a spline: which cell a point is in, and what a row needs of its cell."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._cells._polynomials import horner
from jaxfit._cells._rows import Rows, make_rows
from jaxfit._splines._pieces import Pieces


def rows_of(
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    width: int,
    left_out: Bool[Array, " points"],
) -> Rows:
    """Rows for points with parameters (u, v), without those `left_out`."""
    cell = pieces.axis_u.locate(u) * pieces.axis_v.cells + pieces.axis_v.locate(v)
    return make_rows(jnp.where(left_out, pieces.cells, cell), pieces.cells, width)


def row_coefficients(pieces: Pieces, rows: Rows) -> Float[Array, "d K L rows 1"]:
    """Every row's polynomial, ready to broadcast along the row."""
    return jnp.moveaxis(pieces.coefficients[rows.cell], 0, -1)[..., None]


def local_coordinates(
    pieces: Pieces, cell: Int[Array, "..."], u: Float[Array, "..."], v: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Coordinates in [-1, 1]^2 of parameters, within cells given by number."""
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    cell_u, cell_v = cell // axis_v.cells, cell % axis_v.cells
    s = (u - axis_u.centre[cell_u]) / axis_u.half[cell_u]
    return s, (v - axis_v.centre[cell_v]) / axis_v.half[cell_v]


def values_at(
    pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"]
) -> Float[Array, "d points"]:
    """Points on the surface, each with its own cell's polynomial.

    Every coefficient is fetched where it is needed: one loop over the points, with nothing stored between.
    """
    pieces = jax.tree.map(jnp.asarray, pieces)
    d, order_u, order_v = pieces.coefficients.shape[1:]
    cell = pieces.axis_u.locate(u) * pieces.axis_v.cells + pieces.axis_v.locate(v)
    s, t = local_coordinates(pieces, cell, u, v)
    flat, first = pieces.coefficients.reshape(-1), cell * (d * order_u * order_v)
    number = np.arange(d * order_u * order_v).reshape(d, order_u, order_v)
    values = []
    for coordinate in number:
        rows = [horner([flat[first + int(i)] for i in row], t, 0) for row in coordinate]
        values.append(horner(rows, s, 0))
    return jnp.stack(values)
