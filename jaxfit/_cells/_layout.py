"""Rows laid over the pieces of a spline: which cell a point is in, and what a row needs of its cell."""

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._cells._polynomials import evaluate_values
from jaxfit._cells._rows import Rows, make_rows
from jaxfit._splines._pieces import Pieces

BLOCK = 4096


def rows_of(
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    width: int,
    left_out: Bool[Array, " points"] | None = None,
) -> Rows:
    """Rows for points with parameters (u, v), without those `left_out`."""
    cell = pieces.axis_u.locate(u) * pieces.axis_v.cells + pieces.axis_v.locate(v)
    if left_out is not None:
        cell = jnp.where(left_out, pieces.cells, cell)
    return make_rows(cell, pieces.cells, width)


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
    t = (v - axis_v.centre[cell_v]) / axis_v.half[cell_v]
    return s, t


def values_at(
    pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"]
) -> Float[Array, "d points"]:
    """Points on the surface, block by block, each with its own cell's polynomial."""
    points = u.shape[0]
    size = min(BLOCK, points)

    def block(uv: Float[Array, "2 size"]) -> Float[Array, "d size"]:
        cell = pieces.axis_u.locate(uv[0]) * pieces.axis_v.cells + pieces.axis_v.locate(uv[1])
        s, t = local_coordinates(pieces, cell, uv[0], uv[1])
        return jnp.stack(evaluate_values(jnp.moveaxis(pieces.coefficients[cell], 0, -1), s, t))

    both = jnp.pad(jnp.stack([u, v]), ((0, 0), (0, -points % size)), mode="edge")
    blocks = lax.map(block, both.reshape(2, -1, size).swapaxes(0, 1))
    return blocks.swapaxes(0, 1).reshape(blocks.shape[1], -1)[:, :points]
