"""Displacements of a grid of surface points along their normals towards a cloud (Azariadis 2004)."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._host_splines import GridEvaluator

PAIRS_PER_BLOCK = 4_000_000  # pairs of grid point and cloud point in memory
# The sum of weights at which the confidence is 1/2; one point on the normal line has 1.
HALF_CONFIDENCE = 0.25
NEIGHBOURS = 8  # cloud points whose mean distance bounds the reach
LEAST_SPACING = 0.3  # of the median: the least spacing of a grid that counts
LEAST_REACH = 1e-9  # of the diagonal: the least reach
SAMPLES = 160  # along each direction, to measure distances


def directed_projection(
    grid: Float[Any, "grid 3"],
    normals: Float[Any, "grid 3"],
    reach: Float[Any, " grid"],
    points: Float[Any, "points 3"],
) -> tuple[Float[Any, " grid"], Float[Any, " grid"]]:
    r"""The displacement of each grid point along its normal, and its confidence, 0 to 1.

    The point p + t n with the least weighted sum of squared distances from the cloud is at

    $$t = \frac{\sum_m w_m\, (q_m - p) \cdot n}{\sum_m w_m}, \qquad
      w_m = e^{-r_m^2 / 2 h^2} / (1 + d_m^2 / h^2)^2 ,$$

    d the distance of the cloud point from p and r from the normal line. With h, the `reach`, about the
    spacing of the grid, points off the line hardly count, and of several sheets on the line the nearest
    counts most. Where no point is near the line the confidence falls to 0, and t has no meaning.
    """
    moves, sure = np.zeros(len(grid)), np.zeros(len(grid))
    step = max(1, PAIRS_PER_BLOCK // max(len(points), 1))
    squares = np.sum(points**2, axis=1)
    for start in range(0, len(grid), step):
        part = slice(start, start + step)
        p, n, scale = grid[part], normals[part], (1 / reach[part] ** 2)[:, None]
        along = n @ points.T - np.sum(n * p, axis=1)[:, None]
        square = np.maximum(np.sum(p**2, axis=1)[:, None] + squares[None] - 2 * (p @ points.T), 0.0)
        near = np.exp(-0.5 * scale * np.maximum(square - along**2, 0.0))
        weight = near / (1 + scale * square) ** 2
        total = weight.sum(axis=1)
        moves[part] = np.sum(weight * along, axis=1) / np.where(total > 0, total, 1.0)
        sure[part] = near.sum(axis=1)
    return moves, sure / (sure + HALF_CONFIDENCE)


def reach_of(grid: Float[Any, "a b 3"], points: Float[Any, "points 3"], share: float) -> Float[Any, "a b"]:
    """The scale h of the weights: `share` of the grid's spacing, or the cloud's distance if that is less.

    Far from the cloud the spacing decides, so that between them the grid's points see all of it; near
    it, only the closest points are to count.
    """
    from scipy.spatial import cKDTree

    rows, columns = (np.linalg.norm(np.gradient(grid, axis=k), axis=2) for k in (0, 1))
    spacing = share * np.sqrt((rows**2 + columns**2) / 2)
    spacing = np.maximum(spacing, LEAST_SPACING * np.median(spacing))
    nearest = cKDTree(points).query(grid.reshape(-1, 3), min(NEIGHBOURS, len(points)))[0]
    distance = nearest.reshape(*spacing.shape, -1).mean(axis=2)
    return np.maximum(np.minimum(spacing, distance), LEAST_REACH)


def mean_distance(
    net: Float[Any, "nu nv 3"],
    knots: tuple[Float[Any, " knots_u"], Float[Any, " knots_v"]],
    order: tuple[int, int],
    points: Float[Any, "points 3"],
) -> float:
    """Mean distance from the cloud to the surface, to the tangent planes of the nearest of many samples."""
    from scipy.spatial import cKDTree

    ends = [np.linspace(t[0], t[-1], SAMPLES) for t in knots]
    evaluator = GridEvaluator(knots, order, *ends)
    grid, normals = evaluator.points(net), evaluator.normals(net).reshape(-1, 3)
    steps = [np.linalg.norm(np.diff(grid, axis=k), axis=2).mean() for k in (0, 1)]
    samples = grid.reshape(-1, 3)
    distance, nearest = cKDTree(samples).query(points)
    above = np.sum((points - samples[nearest]) * normals[nearest], axis=1)
    beside = np.sqrt(np.maximum(distance**2 - above**2, 0.0))
    return float(np.mean(np.hypot(above, np.maximum(beside - max(steps), 0.0))))
