"""Cold starts: where on the surface to begin looking, so that the foot found is the nearest of all.

The surface is sampled a few times per cell. A foot at distance d can have a nearer rival elsewhere only if
some sample is within sqrt(d^2 + 2 rho^2) of the point, rho being half the local sample spacing: the
sample next to the rival. So every such sample that is not beside a foot already found is a start.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells import evaluate_values
from jaxfit._splines._pieces import Axis, Pieces

LEAST_SAMPLES = 24  # per direction, for surfaces of few cells
MOST_SAMPLES = 400_000  # in all, for nets of very many cells
SLACK = 2.0  # in rho^2
BESIDE = 1.5  # samples
NEIGHBOURS, MORE_NEIGHBOURS = 8, 40
MOST_ROUNDS = 6
BLOCK = 2048


class Samples(NamedTuple):
    """Points of the surface on a grid of parameters, ends included."""

    u: Float[Array, " a"]
    v: Float[Array, " b"]
    points: Float[Array, "a b d"]
    slack: Float[Array, "a b"]  # SLACK times the squared half spacing around each sample


def samples_per_cell(cells: int, across: int) -> int:
    """Samples along one direction of `cells` spans, the other having `across`."""
    if cells == 1 and across == 1:
        return 2 * LEAST_SAMPLES
    most = max(2, math.isqrt(MOST_SAMPLES // (cells * across)))
    return min(most, max(3, -(-LEAST_SAMPLES // cells)))


def sample(pieces: Pieces) -> Samples:
    """Sample every cell evenly, and the borders."""
    axis_u, axis_v = pieces.axis_u, pieces.axis_v
    flat = pieces.coefficients.shape[-1] == 1  # a curve: nothing happens along v
    count_u = samples_per_cell(axis_u.cells, axis_v.cells)
    count_v = samples_per_cell(axis_v.cells, axis_u.cells)
    u = _along(axis_u, count_u)
    v = axis_v.breaks[:1] if flat else _along(axis_v, count_v)
    cell_u, cell_v = axis_u.locate(u), axis_v.locate(v)
    s = (u - axis_u.centre[cell_u]) / axis_u.half[cell_u]
    t = (v - axis_v.centre[cell_v]) / axis_v.half[cell_v]
    cell = cell_u[:, None] * axis_v.cells + cell_v[None, :]
    shape = cell.shape
    coefficients = jnp.moveaxis(pieces.coefficients[cell], (0, 1), (-2, -1))
    s, t = jnp.broadcast_to(s[:, None], shape), jnp.broadcast_to(t[None, :], shape)
    points = jnp.stack(evaluate_values(coefficients, s, t), axis=-1)
    return Samples(u, v, points, 0.25 * SLACK * (_gap2(points, 0) + _gap2(points, 1)))


def _along(axis: Axis, count: int) -> Float[Array, " a"]:
    share = (jnp.arange(count, dtype=axis.breaks.dtype) + 0.5) / count
    low, width = axis.breaks[:-1, None], (axis.breaks[1:] - axis.breaks[:-1])[:, None]
    inner = (low + width * share[None, :]).reshape(-1)
    return jnp.concatenate([axis.breaks[:1], inner, axis.breaks[-1:]])


def _gap2(points: Float[Array, "a b d"], axis: int) -> Float[Array, "a b"]:
    """Squared distance to the farther neighbour along an axis."""
    if points.shape[axis] == 1:
        return jnp.zeros(points.shape[:2], points.dtype)
    gaps = jnp.sum(jnp.diff(points, axis=axis) ** 2, axis=-1)
    before = jnp.pad(gaps, [(1, 0) if i == axis else (0, 0) for i in range(2)])
    after = jnp.pad(gaps, [(0, 1) if i == axis else (0, 0) for i in range(2)])
    return jnp.maximum(before, after)


class Search:
    """The samples around every point, on the host, and which of them are still to be tried."""

    def __init__(self, samples: Samples, points: Float[np.ndarray, "points d"]):
        from scipy.spatial import KDTree

        self.u, self.v = np.asarray(samples.u), np.asarray(samples.v)
        cloud = np.asarray(samples.points, np.float64)
        self.slack = np.asarray(samples.slack, np.float64).reshape(-1)
        self.tree = KDTree(
            cloud.reshape(-1, cloud.shape[-1]), balanced_tree=False, compact_nodes=False
        )
        self.points = points
        self.count = min(NEIGHBOURS, self.tree.n)
        self.distance, self.index = self._query(np.arange(len(points)), self.count)

    def _query(self, which: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        distance, index = self.tree.query(self.points[which], k=count, workers=-1)
        return distance.reshape(-1, count), index.reshape(-1, count)

    def nearest(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters of the nearest sample of every point."""
        return self._parameters(self.index[:, 0])

    def _parameters(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.u[index // self.v.size], self.v[index % self.v.size]

    def rivals(self, u: np.ndarray, v: np.ndarray, distance: np.ndarray) -> "Rivals":
        """The samples that may lead to a foot nearer than those at (u, v)."""
        limit = distance**2
        last = self.index[:, -1]
        crowded = np.flatnonzero(self.distance[:, -1] ** 2 <= limit + self.slack[last])
        parts = []
        calm = np.setdiff1d(np.arange(len(limit)), crowded, assume_unique=True)
        for which, near, index in (
            (calm, self.distance[calm], self.index[calm]),
            (crowded, *self._query(crowded, min(MORE_NEIGHBOURS, self.tree.n))),
        ):
            open_ = near**2 <= limit[which, None] + self.slack[index]
            some = open_.any(axis=1)
            parts.append((which[some], index[some], open_[some]))
        return Rivals(self, parts, u, v)


class Rivals:
    """Samples still to be tried; shrinks with every foot that is found."""

    def __init__(self, search: Search, parts: list[Any], u: np.ndarray, v: np.ndarray):
        self.search, self.parts = search, parts
        self.found(u, v)

    def found(self, u: np.ndarray, v: np.ndarray) -> None:
        """Drop the samples beside the feet at (u, v), which are given for all points."""
        search = self.search
        row = np.interp(u, search.u, np.arange(search.u.size))
        column = np.interp(v, search.v, np.arange(search.v.size))
        left = []
        for which, index, open_ in self.parts:
            far_u = np.abs(index // search.v.size - row[which, None]) > BESIDE
            far_v = np.abs(index % search.v.size - column[which, None]) > BESIDE
            open_ = open_ & (far_u | far_v)
            some = open_.any(axis=1)
            left.append((which[some], index[some], open_[some]))
        self.parts = left

    def next(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points with a sample to try and its parameters; the sample counts as tried."""
        points, starts = [], []
        for which, index, open_ in self.parts:
            first = open_.argmax(axis=1)
            rows = np.arange(len(which))
            starts.append(index[rows, first])
            points.append(which)
            open_[rows, first] = False
        return np.concatenate(points), *self.search._parameters(np.concatenate(starts))


def best_samples(
    samples: Samples, target: Float[Array, "d points"]
) -> tuple[Float[Array, "2 points"], Float[Array, "2 points"]]:
    """Parameters of the nearest sample, and of the nearest one not beside it, by brute force in blocks.

    The path inside `jit`, where no tree can be built: exact search over all samples, two starts.
    """
    a, b = samples.u.shape[0], samples.v.shape[0]
    cloud = samples.points.reshape(a * b, -1)
    row, column = jnp.arange(a * b) // b, jnp.arange(a * b) % b
    points = target.shape[1]
    size = max(1, min(points, BLOCK * 1024 // (a * b)))
    padded = jnp.pad(target, ((0, 0), (0, -points % size)), mode="edge")

    def block(goal: Float[Array, "d size"]) -> tuple[Array, Array]:
        square = sum((cloud[:, k, None] - goal[k][None, :]) ** 2 for k in range(cloud.shape[1]))
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
