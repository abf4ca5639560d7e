"""Nodes for clouds whose noise is as large as the distances between points: fewer ones, on planes of many."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._scan._even_choice import even_choice

NEIGHBOURS = 16  # of a point, whose plane tells its noise
NOISY = 0.1  # of the spacing: usual distance from that plane, from which on a mesh of all points fails
ROUNDS = 3  # each with half as many nodes along either direction as the one before,
PER_NODE = 6  # and planes of so many points for each point that a node stands for
ENTRIES = 1 << 20  # neighbours at once


def is_noisy(points: Float[Any, "points 3"]) -> bool:
    """Whether distances from the planes of neighbours are comparable to those from neighbours."""
    from scipy.spatial import cKDTree

    spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    away = np.linalg.norm(on_planes(points, NEIGHBOURS) - points, axis=1)
    return bool(np.median(away) > NOISY * spacing)


def denoised_nodes(points: Float[Any, "points 3"], round: int) -> Float[Any, "nodes 3"]:
    """About one node for 4 points in the first round, 16 in the second and so on."""
    share = 4**round
    moved = on_planes(points, PER_NODE * share)
    return moved[even_choice(moved, max(len(points) // share, 1))]


def on_planes(points: Float[Any, "points 3"], count: int) -> Float[Any, "points 3"]:
    """Every point on the plane of least squares of its `count` neighbours, itself among them."""
    from scipy.spatial import cKDTree

    count, tree, moved = min(count, len(points)), cKDTree(points), np.empty_like(points)
    rows = max(ENTRIES // count, 1)
    for k in range(0, len(points), rows):
        some = points[k : k + rows]
        near = points[tree.query(some, count)[1]]
        centre = near.mean(axis=1)
        steps = near - centre[:, None]
        normal = np.linalg.eigh(np.swapaxes(steps, 1, 2) @ steps)[1][:, :, 0]
        moved[k : k + rows] = some - np.sum((some - centre) * normal, axis=1, keepdims=True) * normal
    return moved
