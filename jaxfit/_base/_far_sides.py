"""Which sides of a boundary are not where the points are."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._boundary import Boundary, diagonal
from jaxfit._base._douglas_peucker import chord_lengths

SAMPLES = 200  # of each side
SPREADS, TOLERANCES, LEAST = 4.0, 10.0, 5e-3  # a side is far if its distance is more than each of these
COUNTS, LEVEL = (8, 16, 32, 64), 0.4  # of near points: the first whose spread across is so much of that along


def far_sides(
    points: Float[np.ndarray, "points d"], boundary: Boundary, tolerance: float
) -> dict[str, float]:
    """Sides that are far from the nearest points, and the median distance as a fraction of the diagonal.

    Far means several times as far as these points are from each other, also where they are in lines, and many
    times the tolerance.
    """
    from scipy.spatial import cKDTree

    points = np.unique(points, axis=0)
    size, tree, far = diagonal(points), cKDTree(points), {}
    for name in ("v0", "v1", "u0", "u1"):
        distance, nearest = tree.query(_samples(np.asarray(getattr(boundary, name), float)))
        median = float(np.median(distance))
        if median <= max(TOLERANCES * tolerance, LEAST) * size:
            continue
        if median > SPREADS * float(np.median(_spread(tree, points, nearest))):
            far[name] = median / size
    return far


def _spread(tree: Any, points: Float[np.ndarray, "points d"], chosen: np.ndarray) -> np.ndarray:
    """The second principal standard deviation of the nearest points, so many that they are in no line."""
    spread, left = np.zeros(len(chosen)), np.arange(len(chosen))
    for count in COUNTS:
        number = min(count, len(points))
        near = points[tree.query(points[chosen[left]], number)[1]]
        sizes = np.linalg.svd(near - near.mean(axis=1, keepdims=True), compute_uv=False)[:, :2]
        spread[left] = sizes[:, -1] / np.sqrt(number)
        left = left[sizes[:, -1] < LEVEL * sizes[:, 0]]
        if not left.size:
            break
    return spread


def _samples(side: Float[np.ndarray, "vertices d"]) -> Float[np.ndarray, "samples d"]:
    """Points at equal lengths along the side."""
    length = chord_lengths(side)
    at = np.linspace(0.0, length[-1], SAMPLES)
    return np.stack([np.interp(at, length, x) for x in side.T], axis=1)
