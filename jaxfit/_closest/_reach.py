"""The distance below which a foot is the nearest: the reach of the surface, estimated sample by sample.

Let p be a foot of q at the distance d, and p + x another point of the surface. It is nearer to q only if
|x|^2 < 2 (q - p).x, and q - p is normal to the surface (on a border it may point outwards too), so only if

    d > |x|^2 / (2 |x_n|),      x_n the normal part of x.

The least of these over all x is the reach at p (Federer 1959): up to it no foot is any but the nearest. It
is taken over pairs of neighbouring samples, and with half the radius of curvature at samples. Farther ones
are at least a radius R away, which alone gives R / 2. What lies between samples is left to a factor of
safety: this is an estimate, not a proof.
"""

import math
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._closest._samples import grid_jet
from jaxfit._cores import on_all_cores
from jaxfit._splines._pieces import Axis

SAFETY = 0.3  # of the reach found over pairs of samples
SHARE_OF_RADIUS = 0.5  # of the least radius of curvature, which is exact at samples
# A sample with the fewest neighbours costs about as much as the search for so many points.
POINTS_PER_SAMPLE = 6
LEAST_INTERVALS = 16  # between samples along each direction; one a cell where there are more cells
NEIGHBOURS = 33, 129  # samples around one, itself included; more where that proves enough other feet
ADJACENT = 2  # samples so close along both parameters show the curvature
# How far, in samples along each direction, two points of the surface may move against the samples beside.
# In one plane it is 1/2, for each of the four samples around a foot has its pairs.
MOVE = 0.7
OUTERMOST = 4  # of the neighbours
ROUNDING = 1e-6  # of a squared length
LEAF = 16  # samples
POINTS = 1 << 16  # at a time
BLOCK = 1 << 14  # samples times neighbours: so few that everything stays in the caches


class Reach:
    """The reach between samples of a surface in space, as far as the distances of some feet ask for it."""

    def __init__(self, net: Float[np.ndarray, "nu nv d"], axis_u: Axis, axis_v: Axis):
        from scipy.spatial import KDTree

        self.axes = axis_u, axis_v
        along = [_parameters(axis) for axis in self.axes]
        (u, cell_u), (v, cell_v) = along
        jet: Any = grid_jet(net, self.axes, (u, v), (cell_u, cell_v), 2)
        a, b = (2.0 / _samples_per_cell(axis) for axis in self.axes)  # derivatives of a sample

        def derivative(i: int, j: int) -> np.ndarray:
            return (a**i * b**j) * np.moveaxis(jet[:, i, j], 1, 0).reshape(net.shape[2], -1)

        self.shape = u.size, v.size
        self.points, du, dv = derivative(0, 0), derivative(1, 0), derivative(0, 1)
        self.diagonal = _diagonals(self.points.reshape(-1, *self.shape)).reshape(-1)
        E, F, G = (_dot(x, y) for x, y in ((du, du), (du, dv), (dv, dv)))
        one = np.maximum(E * G - F * F, ROUNDING * E * G) + np.finfo(E.dtype).tiny
        self.normal = np.cross(du, dv, axis=0) / np.sqrt(one)
        self.tangents = du, dv
        # A vector is x = s du + t dv + x_n, with s = x . dual_u and t = x . dual_v.
        self.dual_u, self.dual_v = (G * du - F * dv) / one, (E * dv - F * du) / one
        self.forms = E, F, G
        L, M, N = (_dot(derivative(*which), self.normal) for which in ((2, 0), (1, 1), (0, 2)))
        mean, gauss = (E * N - 2 * F * M + G * L) / (2 * one), (L * N - M * M) / one
        most_curved = np.abs(mean) + np.sqrt(np.maximum(mean * mean - gauss, 0))
        self.half_radius = SHARE_OF_RADIUS / np.maximum(most_curved, np.finfo(E.dtype).tiny)
        self.tree = KDTree(self.points.T, LEAF, balanced_tree=False, compact_nodes=False)
        # By the number of neighbours, what `_reach_at` found at the samples asked for so far; elsewhere NaN.
        self.limits = {count: np.full((2, self.points.shape[1]), np.nan) for count in NEIGHBOURS}

    def exceeds(self, u: np.ndarray, v: np.ndarray, distance: np.ndarray) -> Bool[np.ndarray, " points"]:
        """Whether the reach at the feet (u, v) exceeds their `distance` from their points."""
        a, b = self.shape
        parts = [slice(begin, begin + POINTS) for begin in range(0, u.size, POINTS)]
        place = np.concatenate(on_all_cores(lambda part: self._place(u[part], v[part]), parts))
        below, left = np.zeros(place.size, bool), np.arange(place.size)
        for count in NEIGHBOURS:
            asked = np.zeros((a - 1, b - 1), bool)
            asked.reshape(-1)[place[left]] = True
            samples = np.flatnonzero(_around(asked, np.logical_or, False))
            cost = POINTS_PER_SAMPLE * samples.size * count / NEIGHBOURS[0]
            if count > NEIGHBOURS[0] and left.size <= cost:
                break
            reach, most = self._reach_between(samples, count)[:, place[left]]
            below[left] = distance[left] <= reach
            left = left[(distance[left] > reach) & (distance[left] <= most)]
        return below

    def _place(self, u: np.ndarray, v: np.ndarray) -> Int[np.ndarray, " points"]:
        """The numbers of the rectangles between samples that feet lie in."""
        (axis_u, axis_v), (a, b) = self.axes, self.shape
        return _interval(axis_u, u, a - 1) * (b - 1) + _interval(axis_v, v, b - 1)

    def _reach_between(self, number: np.ndarray, count: int) -> Float[np.ndarray, "2 places"]:
        """The least of `_reach_at` the four samples around each place, as far as these are asked for."""
        limits, step = self.limits[count], max(1, BLOCK // count)
        new = number[np.isnan(limits[0, number])]
        parts = [new[begin : begin + step] for begin in range(0, new.size, step)]
        at_samples = partial(self._reach_at, count=min(count, self.tree.n))
        for part, found in zip(parts, on_all_cores(at_samples, parts), strict=True):
            limits[:, part] = found
        return np.stack([_least_of_four(x.reshape(self.shape)).reshape(-1) for x in limits])

    def _reach_at(self, number: np.ndarray, count: int) -> Float[np.ndarray, "2 samples"]:
        """The reach at samples from `count` neighbours, and what more neighbours could raise it to."""
        away, beside = self.tree.query(self.points.T[number], count)
        away, beside = (np.ascontiguousarray(x.reshape(-1, count).T) for x in (away, beside))
        x = [p.take(beside[1:]) - p[number] for p in self.points]
        s, t = (_dot(x, dual[:, number]) for dual in (self.dual_u, self.dual_v))
        E, F, G = (form[number] for form in self.forms)
        normal = self.normal[:, number]
        height = np.abs(_dot(x, normal))
        close = self._are_close(number, beside[1:])
        # Points of other parts of the surface are not where their samples are: each of these may move.
        turned = MOVE * sum(
            np.abs(_dot([y.take(beside[1:]) for y in tangent], normal)) for tangent in self.tangents
        )
        s_left, t_left = (np.copysign(np.maximum(np.abs(y) - MOVE, 0), y) for y in (s, t))
        along2 = np.maximum(E * s_left**2 + 2 * F * s_left * t_left + G * t_left**2, 0)
        worst = np.clip(np.sqrt(along2), np.maximum(height - turned, 0), height + turned)
        square = np.where(close, away[1:] ** 2, worst**2 + along2)
        height = np.hypot(np.where(close, height, worst), self._outward_part(number, s, t))
        tiny = np.finfo(away.dtype).tiny  # where samples coincide, the reach is zero
        pairs = np.min(square / (2 * np.maximum(height, np.sqrt(ROUNDING) * away[1:]) + tiny), axis=0)
        reach = most = np.minimum(SAFETY * pairs, self.half_radius[number])
        if count < self.tree.n:
            # Of the samples that are not among these, the nearest are like the last ones that are.
            others = self.diagonal[beside[-OUTERMOST:]].max(axis=0)
            radius = away[-1] - 0.5 * (self.diagonal[number] + others)
            reach = np.minimum(most, 0.5 * np.maximum(radius, 0))
        return np.stack([reach, most])

    def _are_close(self, number: np.ndarray, beside: np.ndarray) -> Bool[np.ndarray, "neighbours samples"]:
        """Whether at most ADJACENT samples apart along u and along v."""
        width = np.int32(self.shape[1])
        row, column = np.divmod(number.astype(np.int32), width)
        there_row, there_column = np.divmod(beside.astype(np.int32), width)
        return (np.abs(there_row - row) <= ADJACENT) & (np.abs(there_column - column) <= ADJACENT)

    def _outward_part(self, number: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """How far vectors point out of the domain, at samples on its border."""
        a, b = self.shape
        row, column = np.divmod(number, b)
        part = np.zeros_like(s)
        for place, last, x, dual in ((row, a - 1, s, self.dual_u), (column, b - 1, t, self.dual_v)):
            for side, sign in ((0, -1.0), (last, 1.0)):
                at = np.flatnonzero(place == side)
                length2 = np.maximum(_dot(dual[:, number[at]], dual[:, number[at]]), np.finfo(float).tiny)
                part[:, at] += np.maximum(sign * x[:, at], 0) ** 2 / length2
        return np.sqrt(part)


def number_of_samples(axis_u: Axis, axis_v: Axis) -> int:
    """How many samples `Reach` takes, which is what it costs."""
    return math.prod(_cells(axis) * _samples_per_cell(axis) + 1 for axis in (axis_u, axis_v))


def _cells(axis: Axis) -> int:
    first, last = axis.ends
    return int(last) + 1 - int(first)


def _samples_per_cell(axis: Axis) -> int:
    return -(-LEAST_INTERVALS // _cells(axis))


def _parameters(axis: Axis) -> tuple[Any, np.ndarray]:
    """Parameters of the samples and the cells they lie in; the last sample ends the last cell."""
    first, last = axis.ends
    count = _samples_per_cell(axis)
    cell = np.append(np.repeat(np.arange(first, last + 1), count), last)
    share = np.append(np.tile(np.arange(count) / count, last + 1 - first), 1.0)
    return axis.centre[cell] + axis.half[cell] * (2.0 * share - 1.0), cell


def _interval(axis: Axis, x: np.ndarray, count: int) -> np.ndarray:
    """The number of the interval between samples, along one direction."""
    first, last = axis.ends
    knots = np.asarray(axis.breaks)[first : last + 2]
    place = np.interp(x, knots, np.arange(knots.size, dtype=np.float64) * _samples_per_cell(axis))
    return np.minimum(place.astype(np.int32), count - 1)


def _diagonals(points: Float[np.ndarray, "d a b"]) -> Float[np.ndarray, "a b"]:
    """The longest diagonal of the rectangles around each sample."""
    ways = (points[:, 1:, 1:] - points[:, :-1, :-1], points[:, 1:, :-1] - points[:, :-1, 1:])
    longest = np.sqrt(np.maximum(*(_dot(x, x) for x in ways)))
    return _around(longest, np.maximum, 0.0)


def _around(rectangles: np.ndarray, combine: Any, outside: Any) -> np.ndarray:
    """At every sample, the four rectangles around it combined."""
    padded = np.pad(rectangles, 1, constant_values=outside)
    both = combine(padded[1:], padded[:-1])
    return combine(both[:, 1:], both[:, :-1])


def _least_of_four(x: Float[np.ndarray, "a b"]) -> np.ndarray:
    both = np.minimum(x[:-1], x[1:])
    return np.minimum(both[:, :-1], both[:, 1:])


def _dot(x: Any, y: Any) -> np.ndarray:
    result = x[0] * y[0]
    for k in range(1, len(x)):
        result += x[k] * y[k]
    return result
