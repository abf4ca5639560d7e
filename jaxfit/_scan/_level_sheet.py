"""Sheets of clouds that are level but rough: nodes are medians over squares of the principal plane.

Buildings and trees in a survey from the air, or noise coarser than the points are dense, leave no surface
that neighbours in space agree on. Where the whole cloud is flat, it is a sheet over its principal plane
nevertheless.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._scan._gap_closing import with_gaps_closed
from jaxfit._scan._manifold import Faces, longest_edges, manifold

FLATTEST = 0.2  # the largest spread across the plane, over the smaller one within it
POINTS_A_NODE = 4


def principal_frame(points: Float[Any, "points 3"]) -> tuple[Float[Any, "3 3"], Float[Any, "3"]]:
    """Rows: the two axes of the plane and its normal, right-handed; and the spreads along them."""
    values, axes = np.linalg.eigh(np.cov(points.T))
    frame = axes[:, ::-1].T
    frame = frame * np.where(frame[np.arange(3), np.argmax(np.abs(frame), axis=1)] < 0, -1, 1)[:, None]
    if np.linalg.det(frame) < 0:
        frame[0] = -frame[0]
    return frame, np.sqrt(np.maximum(values[::-1], 0.0))


def is_level(points: Float[Any, "points 3"]) -> bool:
    """Whether a plane describes the cloud as a whole."""
    spread = principal_frame(points)[1]
    return bool(spread[2] < FLATTEST * spread[1])


def level_nodes(flat: Float[Any, "points 3"], most: int) -> Float[np.ndarray, "nodes 3"]:
    """At most about `most` squares with points, the medians of whose coordinates are the nodes."""
    wanted = max(min(most, len(flat) // POINTS_A_NODE), 1)
    size = np.sqrt(np.prod(np.ptp(flat[:, :2], axis=0)) / wanted)
    cell = np.floor((flat[:, :2] - flat[:, :2].min(axis=0)) / size).astype(int)
    _, number, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    number, first = number.reshape(-1), np.cumsum(count) - count
    nodes = np.empty((len(count), 3))
    for axis in range(3):
        order = np.lexsort((flat[:, axis], number))
        nodes[:, axis] = flat[order[first + count // 2], axis]
    return nodes


def level_mesh(nodes: Float[Any, "nodes 3"], length: float) -> Faces:
    """Delaunay's triangles in the plane, without edges longer than `length` there."""
    from scipy.spatial import Delaunay

    plane = nodes * [1, 1, 0]
    faces = Delaunay(nodes[:, :2]).simplices
    a, b, c = (nodes[faces[:, k], :2] for k in range(3))
    left = (b - a)[:, 0] * (c - a)[:, 1] > (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where(left[:, None], faces, faces[:, [0, 2, 1]])
    faces = manifold(faces[longest_edges(plane, faces) <= length])
    return with_gaps_closed(plane, faces, length) if len(faces) else faces
