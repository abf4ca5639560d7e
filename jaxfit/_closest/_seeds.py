"""Cold starts: where on the surface to begin looking, so that the foot found is the nearest of all.

The surface is sampled a few times per cell, on the knots too. A foot at distance d can have a nearer rival
elsewhere only if the sample next to the rival, at most half a spacing (a, b) away, is close enough: the
residual e of the rival is orthogonal to the tangents (along a crease or border, to the one that matters,
for samples lie on those), so the squared distance of that sample exceeds the rival's by no more than
|step|^2 + |e| |R_uu a^2 + 2 R_uv a b + R_vv b^2|, normal components only. Every sample this close that is
not beside a foot already found is a start.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._cells import Jet, evaluate_jet
from jaxfit._splines._pieces import Axis, Pieces

LEAST_SAMPLES = 24  # per direction, for surfaces of few cells
CURVE_SAMPLES = 24  # per span of a curve
MOST_SAMPLES = 400_000  # in all, for nets of very many cells
SLACK = 2.0  # for steps along u and v that are not at right angles
SAG = 1.5  # for second derivatives that change between samples
WIDER = 1.5  # how much slack may differ among samples equally far from a point
BESIDE = 1.5  # samples
NEIGHBOURS = (8, 24, 80, 200)  # as many as it takes
LEAST_STARTS = 4  # tried although a sample beside them is nearer
BLOCK = 2048


class Samples(NamedTuple):
    """Points of the surface on a grid of parameters, ends included."""

    u: Float[Array, " a"]
    v: Float[Array, " b"]
    points: Float[Array, "a b d"]
    slack: Float[Array, "a b"]  # SLACK times the squared half spacing around each sample
    stretch_u: Int[Array, " a"]  # which smooth stretch between creases a sample belongs to
    stretch_v: Int[Array, " b"]
    sag: Float[Array, "a b"]  # SAG times the second-order normal part of a step, doubled


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
    count_u = CURVE_SAMPLES if flat else samples_per_cell(axis_u.cells, axis_v.cells)
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
    jet = evaluate_jet(coefficients, s, t)
    points = jnp.stack(jet.value, axis=-1)
    slack = 0.25 * SLACK * (_gap2(points, 0) + _gap2(points, 1))
    stretches = axis_u.first[cell_u], axis_v.first[cell_v]
    sag = SAG * _sag(jet, 1.0 / count_u, 1.0 / count_v)
    return Samples(u, v, points, slack, *stretches, sag)


def _along(axis: Axis, count: int) -> Float[Array, " a"]:
    share = jnp.arange(count, dtype=axis.breaks.dtype) / count
    low, width = axis.breaks[:-1, None], (axis.breaks[1:] - axis.breaks[:-1])[:, None]
    return jnp.append((low + width * share[None, :]).reshape(-1), axis.breaks[-1])


def _sag(jet: Jet, a: float, b: float) -> Float[Array, "a b"]:
    """|R_ss| a^2 + 2 |R_st| a b + |R_tt| b^2, of the components normal to the surface."""
    s, t, *seconds = (jnp.stack(x, axis=-1) for x in jet[1:])
    t = _without(t, s)
    ss, st, tt = (jnp.linalg.norm(_without(_without(x, s), t), axis=-1) for x in seconds)
    return ss * a**2 + 2.0 * st * a * b + tt * b**2


def _without(x: Float[Array, "a b d"], along: Float[Array, "a b d"]) -> Float[Array, "a b d"]:
    """The part of x at right angles to `along`, or x where that vanishes."""
    square = jnp.sum(along * along, axis=-1, keepdims=True)
    some = square > jnp.finfo(x.dtype).tiny
    share = jnp.sum(x * along, axis=-1, keepdims=True) / jnp.where(some, square, 1.0)
    return x - jnp.where(some, share, 0.0) * along


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
        self.cloud = cloud.reshape(-1, cloud.shape[-1])
        self.slack, self.sag = (np.ravel(x) for x in (samples.slack, samples.sag))
        self.stretch_u, self.stretch_v = (
            np.asarray(samples.stretch_u),
            np.asarray(samples.stretch_v),
        )
        self.tree = KDTree(self.cloud, balanced_tree=False, compact_nodes=False)
        self.points = points
        self.distance, self.index = self._query(np.arange(len(points)), NEIGHBOURS[0])

    def _query(self, which: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        count = min(count, self.tree.n)
        distance, index = self.tree.query(self.points[which], k=count, workers=-1)
        return distance.reshape(-1, count), index.reshape(-1, count)

    def nearest(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters of the nearest sample of every point."""
        return self.parameters(self.index[:, 0])

    def parameters(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parameters of samples given by number."""
        return self.u[index // self.v.size], self.v[index % self.v.size]

    def rivals(self, u: np.ndarray, v: np.ndarray, distance: np.ndarray) -> "Rivals":
        """The samples that may lead to a foot nearer than those at (u, v)."""
        which = np.arange(len(distance))
        near, index = self.distance, self.index
        who, sample = [], []
        steps: tuple[Any, ...] = (*NEIGHBOURS[1:], None)
        for more in steps:
            reach = distance[which, None]
            open_ = near**2 <= reach**2 + self.slack[index] + reach * self.sag[index]
            # Samples farther than the last are taken to have no more than WIDER times its slack.
            wide, wide_sag = (
                np.minimum(x.max(), WIDER * x[index].max(axis=1)) for x in (self.slack, self.sag)
            )
            crowded = near[:, -1] ** 2 <= distance[which] ** 2 + wide + distance[which] * wide_sag
            crowded &= near.shape[1] < self.tree.n and more is not None
            row, column = np.nonzero(open_ & ~crowded[:, None])
            who.append(which[row])
            sample.append(index[row, column])
            which = which[crowded]
            if not which.size:
                break
            near, index = self._query(which, more)
        return Rivals(self, np.concatenate(who), np.concatenate(sample), u, v)

    def is_valley(self, who: np.ndarray, sample: np.ndarray) -> np.ndarray:
        """Whether none of the eight samples around `sample` is nearer to the point `who`.

        Only samples of the same smooth stretch count: a valley may end at a crease.
        """
        a, b = self.u.size, self.v.size
        row, column = sample // b, sample % b
        here = np.sum((self.cloud[sample] - self.points[who]) ** 2, axis=1)
        low = np.ones(len(who), bool)
        for i, j in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
            next_row, next_column = np.clip(row + i, 0, a - 1), np.clip(column + j, 0, b - 1)
            beside = self.cloud[next_row * b + next_column]
            apart = self.stretch_u[next_row] != self.stretch_u[row]
            apart |= self.stretch_v[next_column] != self.stretch_v[column]
            low &= apart | (here <= np.sum((beside - self.points[who]) ** 2, axis=1))
        return low


class Rivals:
    """Pairs (point, sample) still to be tried, grouped by point, the most promising first."""

    def __init__(self, search: Search, who: np.ndarray, sample: np.ndarray, u: np.ndarray, v: np.ndarray):
        self.search, self.who, self.sample = search, who, sample
        self.found(u, v)
        # Valleys of the samples first, and of the rest, which should lead to the same feet, only a few.
        flank = ~search.is_valley(self.who, self.sample)
        order = np.lexsort((flank, self.who))
        self._keep(order)
        flank = flank[order]
        before = np.cumsum(flank) - flank
        first = np.searchsorted(self.who, self.who)
        self._keep(~flank | (before - before[first] < LEAST_STARTS))

    def _keep(self, which: np.ndarray) -> None:
        self.who, self.sample = self.who[which], self.sample[which]

    def found(self, u: np.ndarray, v: np.ndarray) -> None:
        """Drop the samples beside the feet at (u, v), which are given for all points."""
        search = self.search
        far = np.zeros(len(self.who), bool)
        numbers = np.divmod(self.sample, search.v.size)
        axes = ((search.u, search.stretch_u, u), (search.v, search.stretch_v, v))
        for number, (parameters, stretch, foot) in zip(numbers, axes, strict=True):
            at = np.interp(foot[self.who], parameters, np.arange(parameters.size))
            # Across a crease there may be another foot, however close.
            far |= (np.abs(number - at) > BESIDE) | (stretch[number] != stretch[at.astype(int)])
        self._keep(far)

    def first(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One start for each point that has any, taken off the list."""
        first = np.ones(len(self.who), bool)
        first[1:] = self.who[1:] != self.who[:-1]
        who, sample = self.who[first], self.sample[first]
        self._keep(~first)
        return who, *self.search.parameters(sample)

    def rest(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All starts that are left."""
        return self.who, *self.search.parameters(self.sample)


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
