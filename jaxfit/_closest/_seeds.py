"""Cold starts: where on the surface to begin looking, so that the foot found is the nearest of all.

The surface is sampled a few times per cell, on the knots too.
"""

import math
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._checks import is_concrete
from jaxfit._splines._pieces import Axis, Numbers, Pieces

LEAST_SAMPLES = 24  # per direction, for surfaces of few cells
CURVE_SAMPLES = 24  # per span of a curve
MOST_SAMPLES = 400_000  # in all, for nets of very many cells
SLACK = 2.0  # for neighbours that are not at twice the distance of what lies half way
SAG = 1.5  # for second derivatives that change between samples
BLOCK = 2048


class Samples(NamedTuple):
    """Points of the surface on a grid of parameters, ends included."""

    u: Float[Numbers, " a"]
    v: Float[Numbers, " b"]
    points: Float[Numbers, "a b d"]
    slack: Float[Numbers, "a b"]  # SLACK times the squared half distance to the farthest neighbour
    stretch_u: Int[Numbers, " a"]  # which smooth stretch between creases a sample belongs to
    stretch_v: Int[Numbers, " b"]
    sag: Float[Numbers, "a b"]  # SAG times the second-order normal part of a step, doubled


def samples_per_cell(cells: int, across: int) -> int:
    """Samples along one direction of `cells` spans, the other having `across`."""
    if cells == 1 and across == 1:
        return 2 * LEAST_SAMPLES
    most = max(2, math.isqrt(MOST_SAMPLES // (cells * across)))
    return min(most, max(3, -(-LEAST_SAMPLES // cells)))


def sample(pieces: Pieces) -> Samples:
    """Sample every cell evenly, and the borders. On the host, and compiling nothing, where that can be.

    There, creases are sampled on both sides.
    """
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    flat = pieces.coefficients.shape[-1] == 1  # a curve: nothing happens along v
    count_u = CURVE_SAMPLES if flat else samples_per_cell(axis_u.cells, axis_v.cells)
    count_v = samples_per_cell(axis_v.cells, axis_u.cells)
    u = _along(axis_u, count_u)
    v = axis_v.breaks[:1] if flat else _along(axis_v, count_v)
    cell_u, cell_v = axis_u.locate(u), axis_v.locate(v)
    jet = _grid_jet(pieces, u, v, cell_u, cell_v)
    points = jet[0, 0]
    xp: Any = np if is_concrete(points) else jnp
    neighbours = (_gap2(points, i, j) for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)))
    slack = 0.25 * SLACK * reduce(xp.maximum, neighbours)
    sag = SAG * _sag(jet, 1.0 / count_u, 1.0 / count_v)
    return Samples(u, v, points, slack, axis_u.first[cell_u], axis_v.first[cell_v], sag)


def _grid_jet(pieces: Pieces, u: Any, v: Any, cell_u: Any, cell_v: Any) -> Float[Numbers, "3 3 a b d"]:
    """Derivatives in local coordinates up to order (2, 2) on a grid of parameters, direction by direction."""
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    concrete = is_concrete(pieces)
    matmul: Any = np.matmul if concrete else partial(jnp.matmul, precision="highest")
    (order_u, order_v), d = pieces.order, pieces.coefficients.shape[1]
    s = (u - axis_u.centre[cell_u]) / axis_u.half[cell_u]
    t = (v - axis_v.centre[cell_v]) / axis_v.half[cell_v]
    coefficients = np.asarray(pieces.coefficients) if concrete else pieces.coefficients
    cells = coefficients.reshape(axis_u.cells, axis_v.cells, d, order_u, order_v).transpose(0, 3, 1, 4, 2)
    # A small matrix for each sample of one direction, all of the other side by side.
    rows = matmul(_monomials(s, order_u), cells.reshape(axis_u.cells, order_u, -1)[cell_u])
    rows = rows.reshape(-1, 3, axis_v.cells, order_v, d).transpose(2, 3, 1, 0, 4)
    both = matmul(_monomials(t, order_v), rows.reshape(axis_v.cells, order_v, -1)[cell_v])
    return both.reshape(-1, 3, 3, u.shape[0], d).transpose(2, 1, 3, 0, 4)


def _monomials(x: Any, order: int) -> Float[Numbers, "a 3 K"]:
    """1, x, x^2, ... and their first and second derivatives."""
    xp: Any = np if is_concrete(x) else jnp
    power = np.arange(order)
    rows = []
    for i in range(3):
        factor = np.array([math.perm(k, i) for k in range(order)], x.dtype)
        rows.append(factor[None, :] * x[:, None] ** np.maximum(power - i, 0)[None, :])
    return xp.stack(rows, axis=1)


def _along(axis: Axis, count: int) -> Float[Numbers, " a"]:
    xp: Any = np if is_concrete(axis) else jnp
    share = xp.arange(count, dtype=axis.breaks.dtype) / count
    low, width = axis.breaks[:-1, None], (axis.breaks[1:] - axis.breaks[:-1])[:, None]
    along = xp.append((low + width * share[None, :]).reshape(-1), axis.breaks[-1])
    if not axis.creased or not is_concrete(axis):
        return along
    begins = (axis.first == np.arange(axis.cells)) & (axis.breaks[:-1] > axis.breaks[0])
    return np.sort(np.append(along, np.nextafter(axis.breaks[:-1][begins], axis.breaks[0])))


def _sag(jet: Float[Numbers, "3 3 a b d"], a: float, b: float) -> Float[Numbers, "a b"]:
    """|R_ss| a^2 + 2 |R_st| a b + |R_tt| b^2, of the components normal to the surface."""
    s = jet[1, 0]
    t = _without(jet[0, 1], s)
    xp: Any = np if is_concrete(jet) else jnp
    seconds = (_without(_without(x, s), t) for x in (jet[2, 0], jet[1, 1], jet[0, 2]))
    ss, st, tt = (xp.sqrt(_dot(x, x)) for x in seconds)
    return ss * a**2 + 2.0 * st * a * b + tt * b**2


def _without(x: Float[Numbers, "a b d"], along: Float[Numbers, "a b d"]) -> Float[Numbers, "a b d"]:
    """The part of x at right angles to `along`, or x where that vanishes."""
    xp: Any = np if is_concrete(x, along) else jnp
    square = _dot(along, along)
    some = square > jnp.finfo(x.dtype).tiny
    share = _dot(x, along) / xp.where(some, square, 1.0)
    return x - xp.where(some, share, 0.0)[..., None] * along


def _dot(x: Float[Numbers, "a b d"], y: Float[Numbers, "a b d"]) -> Float[Numbers, "a b"]:
    einsum: Any = np.einsum if is_concrete(x, y) else partial(jnp.einsum, precision="highest")
    return einsum("abd,abd->ab", x, y)


def _gap2(points: Float[Numbers, "a b d"], i: int, j: int) -> Float[Numbers, "a b"]:
    """Squared distance to the farther of the neighbours (i, j) and (-i, -j) of a sample, if there are any."""
    xp: Any = np if is_concrete(points) else jnp
    (a, b), (right, left) = points.shape[:2], (max(j, 0), max(-j, 0))
    if i >= a or abs(j) >= b:
        return xp.zeros((a, b), points.dtype)
    step = points[i:, right : b - left] - points[: a - i, left : b - right]
    gaps = _dot(step, step)
    before = xp.pad(gaps, ((i, 0), (right, left)))
    return xp.maximum(before, xp.pad(gaps, ((0, i), (left, right))))


def best_samples(
    samples: Samples, target: Float[Array, "d points"]
) -> tuple[Float[Array, "2 points"], Float[Array, "2 points"]]:
    """Parameters of the nearest sample, and of the nearest one not beside it, by brute force in blocks.

    The path inside `jit`, where no tree can be built: exact search over all samples, two starts.
    """
    samples = jax.tree.map(jnp.asarray, samples)
    a, b = samples.u.shape[0], samples.v.shape[0]
    cloud = samples.points.reshape(a * b, -1)
    row, column = jnp.arange(a * b) // b, jnp.arange(a * b) % b
    points = target.shape[1]
    size = max(1, min(points, BLOCK * 1024 // (a * b)))
    padded = jnp.pad(target, ((0, 0), (0, -points % size)), mode="edge")

    def block(goal: Float[Array, "d size"]) -> tuple[Array, Array]:
        square: Any = sum((cloud[:, k, None] - goal[k][None, :]) ** 2 for k in range(cloud.shape[1]))
        first = jnp.argmin(square, axis=0)
        beside = (jnp.abs(row[:, None] - row[first][None, :]) <= 2) & (
            jnp.abs(column[:, None] - column[first][None, :]) <= 2
        )
        # A rival is a local minimum among the samples, not just the flank of the first one's basin.
        valley = _is_valley(square.reshape(a, b, -1)).reshape(a * b, -1)
        second = jnp.argmin(jnp.where(beside | ~valley, jnp.inf, square), axis=0)
        return first, second

    blocks = padded.reshape(target.shape[0], -1, size).swapaxes(0, 1)
    first, second = (x.reshape(-1)[:points] for x in lax.map(block, blocks))
    index = jnp.stack([first, second])
    return samples.u[index // b], samples.v[index % b]


def _is_valley(square: Float[Array, "a b size"]) -> Array:
    low = jnp.ones(square.shape, bool)
    for axis in (0, 1):
        if square.shape[axis] > 1:
            wall = [(1, 1) if i == axis else (0, 0) for i in range(3)]
            walled = jnp.pad(square, wall, constant_values=jnp.inf)
            low &= square <= lax.slice_in_dim(walled, 0, square.shape[axis], axis=axis)
            low &= square <= lax.slice_in_dim(walled, 2, square.shape[axis] + 2, axis=axis)
    return low
