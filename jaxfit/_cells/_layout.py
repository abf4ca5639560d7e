"""Rows laid over the pieces of a spline: which cell a point is in, and what a row needs of its cell."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, Shaped

from jaxfit._barrier import materialise
from jaxfit._cells._polynomials import Jet, evaluate_jet, horner
from jaxfit._cells._rows import Rows, make_rows
from jaxfit._splines._pieces import Pieces


def cells_of(pieces: Pieces, u: Any, v: Any) -> Any:
    """The number of the cell that each point is in."""
    return pieces.axis_u.locate(u) * pieces.axis_v.cells + pieces.axis_v.locate(v)


def rows_of(
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    width: int,
    left_out: Bool[Array, " points"],
) -> Rows:
    """Rows for points with parameters (u, v), without those `left_out`."""
    return make_rows(jnp.where(left_out, pieces.cells, cells_of(pieces, u, v)), pieces.cells, width)


def row_coefficients(pieces: Pieces, rows: Rows) -> Float[Array, "d K L rows"]:
    """Every row's polynomial."""
    return jnp.moveaxis(pieces.coefficients[rows.cell], 0, -1)


def in_line(x: Shaped[Array, "*before rows width"]) -> Shaped[Array, "*before slots"]:
    """All slots of all rows side by side, for vector loops that are not as short as a row."""
    return x.reshape(*x.shape[:-2], -1)


def in_rows(x: Shaped[Array, "*before slots"], rows: int) -> Shaped[Array, "*before rows width"]:
    """Slots in their rows again, where something belongs to a row."""
    return x.reshape(*x.shape[:-1], rows, -1)


def jet_in_line(
    always: Array,
    coefficients: Float[Array, "d K L rows"],
    s: Float[Array, " slots"],
    t: Float[Array, " slots"],
) -> Jet:
    """Value and derivatives in every slot, each evaluated once (`materialise`)."""
    rows = coefficients.shape[-1]
    jet = materialise(
        always,
        lambda c, s, t: evaluate_jet(c[..., None], s, t),
        coefficients,
        in_rows(s, rows),
        in_rows(t, rows),
    )
    return Jet(*(in_line(x) for x in jet))


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
    cell = cells_of(pieces, u, v)
    s, t = local_coordinates(pieces, cell, u, v)
    flat, first = pieces.coefficients.reshape(-1), cell * (d * order_u * order_v)
    number = np.arange(d * order_u * order_v).reshape(d, order_u, order_v)
    values = []
    for coordinate in number:
        rows = [horner([flat[first + int(i)] for i in row], t, 0) for row in coordinate]
        values.append(horner(rows, s, 0))
    return jnp.stack(values)
