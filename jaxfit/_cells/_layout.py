"""Rows laid over the pieces of a spline: which cell a point is in, and what a row needs of its cell."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int, Shaped

from jaxfit._cells._polynomials import PARTIALS, polynomial_partials
from jaxfit._cells._rows import Rows, make_rows
from jaxfit._splines._evaluate import in_blocks
from jaxfit._splines._pieces import Pieces
from jaxfit._unrolling import root


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


def row_coefficients(pieces: Pieces, rows: Rows) -> Float[Array, "rows d K L"]:
    """Every row's polynomial."""
    return take(pieces.coefficients, rows.cell, 0)


def take(x: Any, index: Int[Array, "..."], axis: int) -> Shaped[Array, "..."]:
    """Entries along an axis, given by numbers that are known to be within bounds."""
    at = (slice(None),) * axis + (index,)
    return jnp.asarray(x).at[at].get(mode="promise_in_bounds", wrap_negative_indices=False)


def local_coordinates(
    pieces: Pieces, cell: Int[Array, "..."], u: Float[Array, "..."], v: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Coordinates in [-1, 1]^2 of parameters, within cells given by number."""
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    cell_u, cell_v = cell // axis_v.cells, cell % axis_v.cells
    middle_u, middle_v = take(axis_u.bounds[2:], cell_u, 1), take(axis_v.bounds[2:], cell_v, 1)
    return (u - middle_u[0]) / middle_u[1], (v - middle_v[0]) / middle_v[1]


def values_at(
    pieces: Pieces, u: Float[Array, " points"], v: Float[Array, " points"]
) -> Float[Array, "d points"]:
    """Points on the surface, each with its own cell's polynomial."""
    return in_blocks(_values_of(pieces), u, v).T


def distances_at(
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    target: Float[Array, "d points"],
    real: Bool[Array, " points"],
) -> Float[Array, " points"]:
    """How far the targets are from the surface at (u, v), 0 for those that are not `real`."""
    values = _values_of(pieces)

    def distances(u: Array, v: Array, real: Array, *target: Array) -> Float[Array, " points"]:
        error = jnp.where(real[:, None], values(u, v) - jnp.stack(target, axis=1), 0.0)
        return root(jnp.sum(error**2, axis=1))

    return in_blocks(distances, u, v, real, *target)


def _values_of(pieces: Pieces) -> Callable[[Array, Array], Float[Array, "points d"]]:
    """The surface as a function of parameters, which fetches a cell's polynomial for each point."""
    pieces = jax.tree.map(jnp.asarray, pieces)
    d, order_u, order_v = pieces.coefficients.shape[1:]
    terms = order_u * order_v
    by_cell = pieces.coefficients.reshape(pieces.cells, d * terms)

    def values(u: Array, v: Array) -> Float[Array, "points d"]:
        cell = cells_of(pieces, u, v)
        s, t = local_coordinates(pieces, cell, u, v)
        own = take(by_cell, cell, 0).reshape(-1, d, terms)
        each = [x[..., 0] for x in lax.split(own, (1,) * terms, 2)]
        return polynomial_partials(each, order_v, s[:, None], t[:, None], PARTIALS[:1])[0]

    return values
