"""Whether a cloud and its boundary can belong together."""

from typing import Any

import numpy as np

from jaxfit._base._boundary import Boundary

LARGEST_RATIO = 100.0  # of the diagonals of the two boxes
LARGEST_GAP = 2.0  # between the boxes, in diagonals of the larger one


def check_same_place(points: Any, boundary: Boundary) -> None:
    """Raise ValueError if concrete points (N, d) and a boundary differ in place or unit.

    Their boxes may be two diagonals apart, of the larger one, and neither diagonal more than a hundred
    times the other. A cloud that bulges far out of its boundary still meets its box.
    """
    lines = (boundary.v0, boundary.v1, boundary.u0, boundary.u1)
    cloud, sides = np.asarray(points, float), np.concatenate([np.asarray(x, float) for x in lines])
    (low, high), (first, last) = ((x.min(axis=0), x.max(axis=0)) for x in (cloud, sides))
    of_cloud, of_sides = float(np.linalg.norm(high - low)), float(np.linalg.norm(last - first))
    small, large = sorted((of_cloud, of_sides))
    gap = float(np.linalg.norm(np.maximum(0.0, np.maximum(low - last, first - high))))
    if large > LARGEST_RATIO * small > 0:
        wrong = (
            f"has a bounding box with the diagonal {of_sides:.3g}, and that of the points is {of_cloud:.3g}"
        )
    elif gap > LARGEST_GAP * large:
        wrong = f"lies {gap:.3g} away from the points, whose bounding box has the diagonal {of_cloud:.3g}"
    else:
        return
    raise ValueError(f"boundary {wrong}; give both in the same unit and frame.")
