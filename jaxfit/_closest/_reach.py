"""A bound below which a foot is certain to be the nearest: the reach of the surface, sample by sample.

Let p be a foot of q at the distance d, and p + x another point of the surface. It is nearer to q only if
|x|^2 < 2 (q - p).x, and q - p is normal to the surface (on a border it may point outwards too), so only if

    d > |x|^2 / (2 |x_n|),      x_n the normal part of x.

The least of these over all x is the reach at p (Federer 1959): up to it no foot is any but the nearest. It
is taken over pairs of neighbouring samples. Farther ones are at least a radius R away, which alone gives R / 2.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxfit._closest._samples import grid_jet
from jaxfit._splines._pieces import Axis

SAFETY = 0.5  # of the reach, which is sampled
PER_CELL = 2  # samples in each direction
NEIGHBOURS = (13, 33)  # samples around one, itself included; the second number where the first proves little
ADJACENT = 2  # samples so close along both parameters show the curvature
# By how much, in samples along each direction, the difference of two points of the surface may differ from that
# of the samples next to them. In one plane it is 1/2, for each of the four samples around a foot has its pairs.
MOVE = 0.7
OUTERMOST = 4  # of the neighbours
ROUNDING = 1e-6  # of a squared length, in its normal part
LEAF = 16  # samples


class Reach:
    """The reach between samples of a surface, as far as the distances of some feet ask for it."""

    def __init__(self, net: Float[np.ndarray, "nu nv d"], axis_u: Axis, axis_v: Axis):
        from scipy.spatial import KDTree

        self.axes = axis_u, axis_v
        along = [_parameters(axis) for axis in self.axes]
        jet = grid_jet(net, self.axes, tuple(x for x, _ in along), tuple(cell for _, cell in along), 1)
        points, du, dv = (
            np.ascontiguousarray(jet[:, i, j].transpose(1, 0, 2)) for i, j in ((0, 0), (1, 0), (0, 1))
        )
        du, dv = (2.0 / PER_CELL) * du, (2.0 / PER_CELL) * dv  # of a sample
        self.shape = points.shape[1:]
        self.diagonal = _diagonals(points).reshape(-1)
        self.points, du, dv = (x.reshape(len(x), -1) for x in (points, du, dv))
        E, F, G = (_dot(x, y) for x, y in ((du, du), (du, dv), (dv, dv)))
        one = np.maximum(E * G - F * F, ROUNDING * E * G) + np.finfo(E.dtype).tiny
        # A vector is x = s du + t dv + x_n, with s = x . dual_u and t = x . dual_v.
        self.dual_u, self.dual_v = (G * du - F * dv) / one, (E * dv - F * du) / one
        self.forms = E, F, G
        self.tree = KDTree(self.points.T, LEAF, balanced_tree=False, compact_nodes=False)

    def proves(self, u: np.ndarray, v: np.ndarray, distance: np.ndarray) -> Bool[np.ndarray, " points"]:
        """Whether the feet at (u, v), `distance` away from their points, are certain to be the nearest."""
        a, b = self.shape
        row, column = (
            _interval(axis, x, count - 1) for axis, x, count in zip(self.axes, (u, v), (a, b), strict=True)
        )
        asked = np.zeros((a - 1) * (b - 1), bool)
        place = row * (b - 1) + column
        asked[place] = True
        corners = asked.reshape(a - 1, b - 1)
        reach = np.full(a * b, np.inf)
        for count in NEIGHBOURS:
            number = np.flatnonzero(_around(corners, np.logical_or, False))
            reach[number] = self._reach_at(number, count)
            least = _least_of_four(reach.reshape(a, b)).reshape(-1)
            proven = distance <= least[place]
            asked[:] = False
            asked[place[~proven]] = True
        return proven

    def _reach_at(self, number: np.ndarray, count: int) -> Float[np.ndarray, " samples"]:
        """The reach at samples, from so many around each."""
        count = min(count, self.tree.n)
        away, beside = self.tree.query(self.points.T[number], count, workers=-1)
        away, beside = (np.ascontiguousarray(x.reshape(-1, count).T) for x in (away, beside))
        x = [p[beside[1:]] - p[number] for p in self.points]
        s, t = (_dot(x, dual[:, number]) for dual in (self.dual_u, self.dual_v))
        E, F, G = (form[number] for form in self.forms)
        square = away[1:] ** 2
        normal2 = np.maximum(square - (E * s * s + 2 * F * s * t + G * t * t), ROUNDING * square)
        apart_u, apart_v = self._apart(number, beside[1:])
        far = np.maximum(np.abs(apart_u), np.abs(apart_v)) > ADJACENT
        s_left, t_left = (np.copysign(np.maximum(np.abs(y) - MOVE, 0), y) for y in (s, t))
        shorter = normal2 + E * s_left**2 + 2 * F * s_left * t_left + G * t_left**2
        square = np.where(far, shorter, square)
        normal2 += self._outward_part(number, s, t)
        reach = np.min(square / (2 * np.sqrt(np.maximum(normal2, np.finfo(float).tiny))), axis=0)
        if count < self.tree.n:
            # Of the samples that are not among these, the nearest are like the last ones that are.
            others = self.diagonal[beside[-OUTERMOST:]].max(axis=0)
            radius = away[-1] - 0.5 * (self.diagonal[number] + others)
            reach = np.minimum(reach, 0.5 * np.maximum(radius, 0) / SAFETY)
        return SAFETY * reach

    def _apart(self, number: np.ndarray, beside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How many samples lie between, along u and v."""
        (row, column), (there_row, there_column) = (
            np.divmod(x.astype(np.int32), np.int32(self.shape[1])) for x in (number, beside)
        )
        return there_row - row, there_column - column

    def _outward_part(self, number: np.ndarray, s: np.ndarray, t: np.ndarray) -> Any:
        """Squared part of vectors that points out of the domain, at samples on its border."""
        a, b = self.shape
        row, column = np.divmod(number, b)
        part = np.zeros_like(s)
        for place, last, x, dual in ((row, a - 1, s, self.dual_u), (column, b - 1, t, self.dual_v)):
            for side, sign in ((0, -1.0), (last, 1.0)):
                at = np.flatnonzero(place == side)
                length2 = np.maximum(_dot(dual[:, number[at]], dual[:, number[at]]), np.finfo(float).tiny)
                part[:, at] += np.maximum(sign * x[:, at], 0) ** 2 / length2
        return part


def _parameters(axis: Axis) -> tuple[np.ndarray, np.ndarray]:
    """Parameters of the samples and the cells they lie in; the last sample ends the last cell."""
    first, last = axis.ends
    cell = np.append(np.repeat(np.arange(first, last + 1), PER_CELL), last)
    share = np.append(np.tile(np.arange(PER_CELL) / PER_CELL, last + 1 - first), 1.0)
    return axis.centre[cell] + axis.half[cell] * (2.0 * share - 1.0), cell


def _interval(axis: Axis, x: np.ndarray, count: int) -> np.ndarray:
    """The number of the interval between samples, along one direction."""
    first, last = axis.ends
    knots = np.asarray(axis.breaks)[first : last + 2]
    place = np.interp(x, knots, np.arange(knots.size, dtype=np.float64) * PER_CELL)
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
