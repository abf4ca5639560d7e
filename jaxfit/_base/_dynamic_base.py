"""The dynamic base surface of Azariadis (2004): a grid on the surface that grows towards the cloud."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._base_method import AbstractBaseMethod
from jaxfit._base._directed_projection import directed_projection, mean_distance, reach_of
from jaxfit._base._displacement_smoothing import smoothed_displacements
from jaxfit._base._host_splines import GridEvaluator, Knots, along_both, basis_matrix
from jaxfit._base._normalised_cloud import Cloud, thinned
from jaxfit._checks import check_number
from jaxfit._splines._knots import greville

LEAST_GAIN = 0.01  # a mean distance has fallen if it did so by this share
MOST_IDLE_LEVELS = 2  # grids that lower nothing before the end


class DynamicBaseSurface(AbstractBaseMethod):
    r"""The Coons surface, moved towards the cloud by a grid of its points that grows finer.

    In every round, points of the surface on a grid are moved along their normals to the weighted
    least-squares position with respect to the cloud,

    $$t = \sum_m w_m (q_m - p) \cdot n \Big/ \sum_m w_m, \qquad
      w_m = e^{-r_m^2 / 2 h^2} / (1 + d_m^2 / h^2)^2$$

    (d the distance of the cloud point from p, r from the normal line, h the least of `reach` grid spacings
    and the mean distance to the nearest cloud points), the moves are smoothed, and the moved grid is
    interpolated with the boundary held. The grid lies at the Greville abscissae of a spline space whose
    interior knots are some of the net's. Rounds go on while the mean distance from the cloud to the surface
    falls by 1 %; then the grid gets `growth` times as many rows and columns. The end is reached when all
    knots are in use, or after two grids in a row that did not lower the distance; the nearest surface met,
    perhaps the Coons surface, is the result.

    Parameters
    ----------
    start : int
        Interior rows and columns of the first grid beyond the order (default 4).
    growth : float
        At least 1.1 (default 1.5).
    stiffness : float
        Of the smoothing, against pulls that are sure (default 0.1, at least 1e-6).
    reach : float
        Default 0.7, at least 0.05: larger is smoother and mixes sheets that lie close.
    rounds : int
        Most rounds on one grid (default 6).
    most_points : int
        A larger cloud is thinned evenly to so many (default 8,000).

    Notes
    -----
    Three dimensions only. Where no cloud point is near a normal line, the surface bends as the smoothing
    asks. Gross outliers have influence only where nothing nearer lies on the line.

    Fails where normals of the first surface do not lead to the cloud, and cannot follow what overhangs more
    than the moved normals see: ears become lumps, which a fit then has to open. Where the cloud bends
    more sharply than its points are dense (the leading edge of a blade), averages lie inside the bend,
    and the Coons surface may be the better one and stay. `Meshless` is nearer to the cloud wherever
    it works at all. Takes 2 to 10 s for a net of 42 x 42 on one core.

    Departs from the source, of which the weights and the growth follow the summary in section 2.3 of
    the paper: displacements are smoothed rather than positions, and a displacement counts less
    where few points are near the normal line.

    Source: P. N. Azariadis, Parameterization of clouds of unorganized points using dynamic base surfaces,
    Computer-Aided Design 36 (2004).

    Raises
    ------
    ValueError
        If an option is out of range, or the boundary is not in three dimensions.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 13), np.linspace(0, 1, 13), indexing="ij")
    >>> grid = np.stack([x, y, 4 * x * (1 - x) * y * (1 - y)], axis=2)
    >>> boundary, points = jf.Boundary.from_grid(grid), grid[1:-1, 1:-1].reshape(-1, 3)
    >>> surface = jf.base_surface(boundary, points, net=(8, 8), method=jf.DynamicBaseSurface())
    >>> abs(float(surface(0.5, 0.5)[2]) - 0.25) < 0.05
    True
    """

    start: int = 4
    growth: float = 1.5
    stiffness: float = 0.1
    reach: float = 0.7
    rounds: int = 6
    most_points: int = 8000

    def __check_init__(self) -> None:
        check_number("start", self.start, 1, whole=True)
        check_number("growth", self.growth, 1.1)
        check_number("stiffness", self.stiffness, 1e-6)
        check_number("reach", self.reach, 0.05)
        check_number("rounds", self.rounds, 1, whole=True)
        check_number("most_points", self.most_points, 1, whole=True)

    def check_dimension(self, dimension: int) -> None:
        """Raise ValueError outside three dimensions."""
        if dimension != 3:
            raise ValueError(
                f"boundary must have 3 coordinates for DynamicBaseSurface(), which needs normals, but has "
                f"{dimension}; use Meshless()."
            )

    def fill(
        self, net: Float[Any, "nu nv d"], knots: Knots, order: tuple[int, int], cloud: Cloud
    ) -> Float[Any, "nu nv d"]:
        """The nearest net met."""
        points = thinned(cloud.points, self.most_points)
        least, best = mean_distance(net, knots, order, points), net
        rows = (self.start, self.start)
        most = tuple(len(t) - 2 * k for t, k in zip(knots, order, strict=True))
        idle = 0
        while idle < MOST_IDLE_LEVELS:
            rows = (min(rows[0], most[0]), min(rows[1], most[1]))
            found, distance = self._level(_Level(net, knots, order, rows), best, points)
            idle = 0 if distance < least * (1 - LEAST_GAIN) else idle + 1
            if distance < least:
                least, best = distance, found
            if rows == most:
                break
            rows = (int(np.ceil(rows[0] * self.growth)), int(np.ceil(rows[1] * self.growth)))
        return best

    def _level(self, level: "_Level", net: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, float]:
        """The nearest net of rounds on one grid, and its mean distance."""
        least, best = np.inf, net
        for _ in range(self.rounds):
            grid, normals = level.evaluator.points(net), level.evaluator.normals(net)
            reach = reach_of(grid, points, self.reach)
            moves, sure = directed_projection(
                grid.reshape(-1, 3), normals.reshape(-1, 3), reach.ravel(), points
            )
            moved = grid - level.base + moves.reshape(reach.shape)[..., None] * normals
            net = level.interpolated(smoothed_displacements(moved, sure.reshape(reach.shape), self.stiffness))
            distance = mean_distance(net, level.knots, level.order, points)
            fell = distance < least * (1 - LEAST_GAIN)
            if distance < least:
                least, best = distance, net
            if not fell:
                break
        return best, least


class _Level:
    """One grid: where it lies, and from displacements on it to a net."""

    def __init__(self, coons: np.ndarray, knots: Knots, order: tuple[int, int], rows: tuple[int, int]):
        self.coons, self.knots, self.order = coons, knots, order
        self._lift, places = [], []
        for t, k, count in zip(knots, order, rows, strict=True):
            few = _some_knots(t, k, count)
            at, all_at = greville(few, k), greville(t, k)
            # Values on the grid to coefficients there, then to those on all knots: exact, since the
            # few span a part of the same space.
            own = np.linalg.inv(basis_matrix(few, k, at))
            raised = np.linalg.solve(basis_matrix(t, k, all_at), basis_matrix(few, k, all_at))
            self._lift.append(raised @ own)
            places.append(at)
        self.evaluator = GridEvaluator(knots, order, *places)
        self.base = self.evaluator.points(coons)

    def interpolated(self, displacements: np.ndarray) -> np.ndarray:
        """The Coons net plus the spline through the displacements, whose border is zero."""
        extra = along_both(self._lift[0], displacements, self._lift[1])
        extra[[0, -1]] = 0.0
        extra[:, [0, -1]] = 0.0
        return self.coons + extra


def _some_knots(knots: np.ndarray, order: int, count: int) -> np.ndarray:
    """`count` of the interior knots, evenly by number, between the ends."""
    inner = knots[order:-order]
    chosen = inner[((np.arange(count) + 0.5) * len(inner) / max(count, 1)).astype(int)]
    return np.concatenate([knots[:order], chosen, knots[-order:]])
