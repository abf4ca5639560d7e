"""Points of a surface on a grid of parameters, from which searches for the nearest foot start."""

import math
from functools import partial, reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._checks import is_concrete
from jaxfit._splines._pieces import Axis, Numbers

LEAST_SAMPLES = 24  # per direction, for surfaces of few cells
CURVE_SAMPLES = 24  # per span of a curve
MOST_SAMPLES = 400_000  # in all, for nets of very many cells
STEP_SAFETY = 2.0  # for neighbours that are not at twice the distance of what lies half way
CURVATURE_SAFETY = 1.5  # for second derivatives that change between samples
BLOCK = 2048


class Samples(NamedTuple):
    """Points of the surface on a grid of parameters, ends included, and how far others may lie from them."""

    u: Float[Numbers, " a"]
    v: Float[Numbers, " b"]
    points: Float[Numbers, "a b d"]
    step_bound: Float[Numbers, "a b"]  # STEP_SAFETY times the squared half distance to the farthest neighbour
    curvature_bound: Float[Numbers, "a b"]  # CURVATURE_SAFETY times twice the normal part of half a step
    stretch_u: Int[Numbers, " a"]  # the smooth stretch between creases that a sample belongs to
    stretch_v: Int[Numbers, " b"]


def samples_per_cell(cells: int, across: int) -> int:
    """Samples along one direction of `cells` spans, the other having `across`."""
    if cells == 1 and across == 1:
        return 2 * LEAST_SAMPLES
    most = max(2, math.isqrt(MOST_SAMPLES // (cells * across)))
    return min(most, max(3, -(-LEAST_SAMPLES // cells)))


def sample(net: Float[np.ndarray, "nu nv d"], axis_u: Axis, axis_v: Axis) -> Samples:
    """Sample every cell evenly, with bounds (concrete). Creases are sampled on both sides."""
    u, v, count_u, count_v = _parameters(axis_u, axis_v)
    cell_u, cell_v = axis_u.locate(u), axis_v.locate(v)
    jet: Any = grid_jet(net, (axis_u, axis_v), (u, v), (cell_u, cell_v), 2).transpose(1, 2, 0, 3, 4)
    points = np.ascontiguousarray(jet[0, 0].transpose(0, 2, 1))
    neighbours = (_squared_gap(jet[0, 0], i, j) for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)))
    step_bound = 0.25 * STEP_SAFETY * reduce(np.maximum, neighbours)
    curvature_bound = CURVATURE_SAFETY * _normal_part(jet, 1.0 / count_u, 1.0 / count_v)
    return Samples(u, v, points, step_bound, curvature_bound, axis_u.first[cell_u], axis_v.first[cell_v])


def sample_points(net: Any, axis_u: Axis, axis_v: Axis) -> tuple[Any, Any, Any]:
    """Parameters u (a,) and v (b,), and the points there (a, b, d)."""
    u, v, _, _ = _parameters(axis_u, axis_v)
    jet = grid_jet(net, (axis_u, axis_v), (u, v), (axis_u.locate(u), axis_v.locate(v)), 0)
    return u, v, jet[:, 0, 0].swapaxes(1, 2)


def _parameters(axis_u: Axis, axis_v: Axis) -> tuple[Any, Any, int, int]:
    """Parameters of the samples, and how many a cell has in each direction."""
    flat = axis_v.polynomials.shape[1] == 1  # a curve: nothing happens along v
    count_u = CURVE_SAMPLES if flat else samples_per_cell(axis_u.cells, axis_v.cells)
    count_v = samples_per_cell(axis_v.cells, axis_u.cells)
    return _along(axis_u, count_u), axis_v.breaks[:1] if flat else _along(axis_v, count_v), count_u, count_v


def _along(axis: Axis, count: int) -> Float[Numbers, " a"]:
    concrete = is_concrete(axis)
    xp: Any = np if concrete else jnp
    share = np.arange(count, dtype=axis.breaks.dtype) / count
    low, width = axis.breaks[:-1, None], (axis.breaks[1:] - axis.breaks[:-1])[:, None]
    along = xp.append((low + width * share[None, :]).reshape(-1), axis.breaks[-1:])
    if not axis.creased or not concrete:
        return along
    begins = (axis.first == np.arange(axis.cells)) & (axis.breaks[:-1] > axis.breaks[0])
    return np.sort(np.append(along, np.nextafter(axis.breaks[:-1][begins], axis.breaks[0])))


def grid_jet(
    net: Any, axes: tuple[Axis, Axis], parameters: tuple[Any, Any], cells: tuple[Any, Any], order: int
) -> Float[Numbers, "a i j d b"]:
    """Derivatives of order (i, j), each up to `order`, in local coordinates, on a grid of parameters.

    One direction after the other: a small matrix of basis functions for each sample.
    """
    xp: Any = np if is_concrete(net, *axes, *parameters) else jnp
    matmul: Any = np.matmul if xp is np else partial(jnp.matmul, precision="highest")
    nu, nv, d = net.shape
    (weights_u, at_u), (weights_v, at_v) = (
        _basis(axis, x, cell, order, net.dtype) for axis, x, cell in zip(axes, parameters, cells, strict=True)
    )
    rows = xp.swapaxes(net, 0, 1).reshape(nv, nu * d)
    half = matmul(weights_v, rows[at_v]).reshape(-1, (order + 1) * nu, d)  # b, j, nu, d
    b = half.shape[0]
    half = half.reshape(b, order + 1, nu, d).transpose(2, 1, 3, 0).reshape(nu, -1)
    return matmul(weights_u, half[at_u]).reshape(-1, order + 1, order + 1, d, b)


def _basis(axis: Axis, x: Any, cell: Any, order: int, dtype: Any) -> tuple[Any, Any]:
    """Basis functions and derivatives, (samples, order + 1, K), and the control points they belong to."""
    xp: Any = np if is_concrete(axis, x) else jnp
    local = ((x - axis.centre[cell]) / axis.half[cell])[:, None, None]
    width = axis.polynomials.shape[1]
    power = np.arange(width) - np.arange(order + 1)[:, None]
    factor = np.array([[math.perm(k, i) for k in range(width)] for i in range(order + 1)], dtype)
    monomials = factor[None] * local ** np.maximum(power, 0)[None]
    weights = xp.matmul(monomials, xp.swapaxes(axis.polynomials[cell], 1, 2))
    return weights.astype(dtype), cell[:, None] + np.arange(width)[None]


def _normal_part(jet: Float[np.ndarray, "3 3 a d b"], a: float, b: float) -> Float[np.ndarray, "a b"]:
    """|R_ss| a^2 + 2 |R_st| a b + |R_tt| b^2, of the components normal to the surface."""
    s = jet[1, 0]
    t = _without(jet[0, 1], s)
    seconds = (_without(_without(x, s), t) for x in (jet[2, 0], jet[1, 1], jet[0, 2]))
    ss, st, tt = (np.sqrt(_dot(x, x)) for x in seconds)
    return ss * a**2 + 2.0 * st * a * b + tt * b**2


def _without(x: Float[np.ndarray, "a d b"], along: Float[np.ndarray, "a d b"]) -> Float[np.ndarray, "a d b"]:
    """The part of x at right angles to `along`, or x where that vanishes."""
    square = _dot(along, along)
    some = square > np.finfo(x.dtype).tiny
    share = np.where(some, _dot(x, along), 0.0) / np.where(some, square, 1.0)
    return x - share[:, None] * along


def _dot(x: Float[np.ndarray, "a d b"], y: Float[np.ndarray, "a d b"]) -> Float[np.ndarray, "a b"]:
    return sum((x[:, k] * y[:, k] for k in range(1, x.shape[1])), x[:, 0] * y[:, 0])


def _squared_gap(points: Float[np.ndarray, "a d b"], i: int, j: int) -> Float[np.ndarray, "a b"]:
    """Squared distance to the farther of the neighbours (i, j) and (-i, -j) of a sample, if there are any."""
    (a, _, b), (right, left) = points.shape, (max(j, 0), max(-j, 0))
    if i >= a or abs(j) >= b:
        return np.zeros((a, b), points.dtype)
    step = points[i:, :, right : b - left] - points[: a - i, :, left : b - right]
    gaps, farther = _dot(step, step), np.zeros((a, b), points.dtype)
    farther[: a - i, left : b - right] = gaps
    here = farther[i:, right : b - left]
    np.maximum(here, gaps, out=here)
    return farther


def best_samples(
    u: Float[Array, " a"], v: Float[Array, " b"], samples: Float[Array, "a b d"], target: Float[Array, "d n"]
) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"]]:
    """Parameters of the nearest sample, and of the nearest local minimum not beside it, by brute force.

    The path inside `jit`, where no tree can be built: exact search over all samples, two starts.
    """
    a, b, d = samples.shape
    cloud = jnp.asarray(samples).reshape(a * b, d)
    row, column = np.divmod(np.arange(a * b, dtype=np.int32)[:, None], b)
    width = np.int32(b)
    far = np.asarray(np.inf, cloud.dtype)
    points = target.shape[1]
    size = max(1, min(points, BLOCK * 1024 // (a * b)))
    padded = jnp.pad(target, ((0, 0), (0, -points % size)), mode="edge")

    def block(goal: Float[Array, "d size"]) -> Array:
        gap = cloud[:, :, None] - goal[None]
        square = sum(gap[:, k] ** 2 for k in range(1, d)) + gap[:, 0] ** 2
        first = lax.argmin(square, 0, np.int32)
        beside = abs(row - lax.div(first, width)[None]) <= 2
        beside &= abs(column - lax.rem(first, width)[None]) <= 2
        # A second start is a local minimum among the samples, not just off the minimum of the first.
        lowest = lax.reduce_window(square.reshape(a, b, -1), far, lax.min, (3, 3, 1), (1, 1, 1), "SAME")
        other = jnp.where(beside | (square > lowest.reshape(a * b, -1)), far, square)
        return jnp.stack([first, lax.argmin(other, 0, np.int32)])

    blocks = padded.reshape(d, -1, size).swapaxes(0, 1)
    index = lax.map(block, blocks).swapaxes(0, 1).reshape(2, -1)[:, :points]
    return jnp.asarray(u)[lax.div(index, width)], jnp.asarray(v)[lax.rem(index, width)]
