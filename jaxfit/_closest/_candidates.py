"""The search for candidates: every sample that could lead to a nearer foot than the one found, on the host.

A foot at distance d can have a nearer one elsewhere only if the sample next to that one, at most half a
spacing (a, b) away, is close enough: the residual e of the nearer foot is orthogonal to the tangents (along a
crease or border, to the one that matters, for samples lie on those), so the squared distance of that sample
exceeds the foot's by no more than |step|^2 + |e| |R_uu a^2 + 2 R_uv a b + R_vv b^2|, normal components
only. Every sample this close that is not beside a foot already found is a start.
"""

import math
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._closest._samples import Samples
from jaxfit._cores import cores, on_all_cores

WIDER = 1.5  # how much slack may differ among samples equally far from a point
BESIDE = 1.5  # samples
NEIGHBOURS = (8, 24, 80, 200)  # as many as it takes
LEAST_STARTS = 4  # tried although a sample beside them is nearer
BLOCK = 8192  # points
LEAF = 32  # samples; the tree's own default is slower here
# Where points outnumber samples so many times, those in one box begin from the same sample.
MANY = 8
SIDE = 0.5  # of a box, against the distance between samples
MOST_BOXES = 1 << 24  # beyond, each point asks the tree
AROUND = 0.05  # of the diagonal: how far from the samples there are boxes


class Search:
    """The samples of a surface, and which of them are still to be tried for a point."""

    def __init__(self, samples: Samples):
        cloud = np.asarray(samples.points, np.float64)
        self.cloud = cloud.reshape(-1, cloud.shape[-1])
        self.step_bound, self.curvature_bound = (
            np.ravel(x) for x in (samples.step_bound, samples.curvature_bound)
        )
        self.most = self.step_bound.max(), self.curvature_bound.max()
        self.along_u = _Direction(samples.u, samples.stretch_u)
        self.along_v = _Direction(samples.v, samples.stretch_v)

    @cached_property
    def tree(self) -> Any:
        """A tree of all samples, made when first asked for."""
        from scipy.spatial import KDTree

        return KDTree(self.cloud, LEAF, balanced_tree=False, compact_nodes=False)

    def _query(self, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        count = min(count, self.tree.n)
        found = self.tree.query(points, k=count)
        distance, index = (np.ascontiguousarray(x.reshape(-1, count).T) for x in found)
        return distance, index

    def nearest(self, points: Float[np.ndarray, "points d"]) -> tuple[np.ndarray, np.ndarray]:
        """Parameters of a sample near every point: the nearest, or where points are many the one nearest to
        the middle of the box that the point is in.
        """
        many = len(points) >= MANY * len(self.cloud)
        boxes = _boxes(self.cloud, SIDE * math.sqrt(np.median(self.step_bound))) if many else None
        if boxes is None:
            return self.parameters(self.tree.query(points, workers=cores())[1])
        low, size, counts = boxes

        def box_of(part: slice) -> np.ndarray:
            place = np.floor((points[part] - low) / size)
            inside = ((place >= 0) & (place < counts)).all(axis=1)
            number = np.ravel_multi_index(tuple(np.where(inside[:, None], place, 0).astype(int).T), counts)
            return np.where(inside, number, -1).astype(np.int32)

        parts = [slice(begin, begin + BLOCK) for begin in range(0, len(points), BLOCK)]
        box = np.concatenate(on_all_cores(box_of, parts))
        sample = np.zeros(math.prod(counts) + 1, np.int32)  # the last is for points outside
        seen = np.zeros(sample.size, bool)
        seen[box], seen[-1] = True, False
        number = np.flatnonzero(seen)
        middles = low + size * (0.5 + np.stack(np.unravel_index(number, counts), axis=1))
        sample[number] = self.tree.query(middles, workers=cores())[1]
        found, outside = sample[box], box < 0
        found[outside] = self.tree.query(points[outside], workers=cores())[1]
        return self.parameters(found)

    def parameters(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parameters of samples given by number."""
        row, column = np.divmod(index, self.along_v.u.size)
        return self.along_u.u[row], self.along_v.u[column]

    def are_apart(self, sample: np.ndarray, u: np.ndarray, v: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Which samples, each for the foot (u, v) with the number `which`, do not lie beside it."""
        row, column = np.divmod(sample, self.along_v.u.size)
        apart = self.along_u.apart(row, u, which) | self.along_v.apart(column, v, which)
        # Round a corner, on the other border, there may be another foot, however close.
        edge_u, edge_v = self.along_u.is_end(u), self.along_v.is_end(v)
        for border, direction, number in (
            (edge_u & ~edge_v, self.along_v, column),
            (edge_v & ~edge_u, self.along_u, row),
        ):
            if border.any():
                apart |= border[which] & direction.is_last(number)
        return apart

    def candidates(
        self, points: Float[np.ndarray, "points d"], u: np.ndarray, v: np.ndarray, distance: np.ndarray
    ) -> "StartCandidates":
        """The samples that may lead to a foot nearer to the points than those at (u, v)."""
        self.tree  # noqa: B018 (before there are threads)
        parts = [slice(begin, begin + BLOCK) for begin in range(0, len(distance), BLOCK)]
        found = on_all_cores(lambda part: self._candidates_of(part, points, u, v, distance), parts)
        who, sample = (np.concatenate(x) for x in zip(*found, strict=True))
        return StartCandidates(self, points, who, sample)

    def _candidates_of(
        self, part: slice, points: np.ndarray, u: np.ndarray, v: np.ndarray, distance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of some points: so few that everything stays in the caches."""
        which = np.arange(len(distance))[part]
        who, sample = [], []
        for count, is_last in ((x, x == NEIGHBOURS[-1]) for x in NEIGHBOURS):
            near, index = self._query(points[which], count)
            reach, step, curvature = distance[which], self.step_bound[index], self.curvature_bound[index]
            open_ = near**2 <= reach**2 + step + reach * curvature
            crowded = np.zeros(len(which), bool)
            if near.shape[0] < self.tree.n and not is_last:
                crowded = self._is_crowded(near[-1], reach, step, curvature)
                open_ &= ~crowded
            row, column = np.nonzero(open_)
            there = index[row, column]
            apart = self.are_apart(there, u[which], v[which], column)
            who.append(which[column[apart]])
            sample.append(there[apart])
            which = which[crowded]
            if not which.size:
                break
        return np.concatenate(who), np.concatenate(sample)

    def _is_crowded(
        self, last: np.ndarray, reach: np.ndarray, step: np.ndarray, curvature: np.ndarray
    ) -> np.ndarray:
        """Where samples farther than the last may matter, having at most WIDER times the bounds of these."""
        most_step, most_curved = self.most
        wide = np.minimum(most_step, WIDER * step.max(axis=0))
        return last**2 <= reach**2 + wide + reach * np.minimum(most_curved, WIDER * curvature.max(axis=0))

    def is_local_minimum(self, point: np.ndarray, sample: np.ndarray) -> np.ndarray:
        """Whether none of the eight samples around `sample` is nearer to the point.

        Only samples of the same smooth stretch count: a local minimum may lie at a crease.
        """
        a, b = self.along_u.u.size, self.along_v.u.size
        row, column = np.divmod(sample, b)
        here = np.sum((self.cloud[sample] - point) ** 2, axis=1)
        low = np.ones(len(sample), bool)
        for i, j in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
            next_row, next_column = np.clip(row + i, 0, a - 1), np.clip(column + j, 0, b - 1)
            beside = self.cloud[next_row * b + next_column]
            apart = self.along_u.stretch[next_row] != self.along_u.stretch[row]
            apart |= self.along_v.stretch[next_column] != self.along_v.stretch[column]
            low &= apart | (here <= np.sum((beside - point) ** 2, axis=1))
        return low


def _boxes(
    cloud: Float[np.ndarray, "samples d"], size: float
) -> tuple[np.ndarray, float, tuple[int, ...]] | None:
    """Corner, size and numbers along each axis of boxes around the samples, unless they would be too many."""
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    margin = AROUND * np.linalg.norm(high - low)
    with np.errstate(divide="ignore", invalid="ignore"):
        counts = np.ceil((high - low + 2 * margin) / size)
    return (low - margin, size, tuple(int(n) for n in counts)) if np.prod(counts) <= MOST_BOXES else None


class _Direction:
    """Samples along one parameter."""

    def __init__(self, u: Any, stretch: Any):
        self.u, self.stretch = np.asarray(u), np.asarray(stretch)
        self.smooth = bool((self.stretch == self.stretch[0]).all())

    def is_end(self, foot: np.ndarray) -> np.ndarray:
        """Whether feet lie at either end."""
        return (foot <= self.u[0]) | (foot >= self.u[-1])

    def is_last(self, number: np.ndarray) -> np.ndarray:
        """Whether samples lie at either end of a direction that has two."""
        return ((number == 0) | (number == self.u.size - 1)) & (self.u.size > 1)

    def apart(self, number: np.ndarray, foot: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Whether samples are more than BESIDE away from the foot number `which`, or in another stretch.

        Across a crease there may be another foot, however close.
        """
        at = np.interp(foot, self.u, np.arange(self.u.size))
        apart = np.abs(number - at[which]) > BESIDE
        if not self.smooth:
            apart |= self.stretch[number] != self.stretch[at.astype(int)][which]
        return apart


class StartCandidates:
    """Pairs (point, sample) still to be tried, grouped by point, the most promising first."""

    def __init__(self, search: Search, points: np.ndarray, who: np.ndarray, sample: np.ndarray):
        self.search, self.who, self.sample = search, who, sample
        # Local minima among the samples first; of the rest, which should lead to the same feet, only a few.
        off_minimum = ~search.is_local_minimum(points[who], self.sample)
        order = np.lexsort((off_minimum, self.who))
        self._keep(order)
        off_minimum = off_minimum[order]
        before = np.cumsum(off_minimum) - off_minimum
        first = np.searchsorted(self.who, self.who)
        self._keep(~off_minimum | (before - before[first] < LEAST_STARTS))

    def _keep(self, which: np.ndarray) -> None:
        self.who, self.sample = self.who[which], self.sample[which]

    def found(self, u: np.ndarray, v: np.ndarray) -> None:
        """Drop the samples beside the feet at (u, v), which are given for all points."""
        self._keep(self.search.are_apart(self.sample, u, v, self.who))

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
