"""Nodes for clouds whose noise is as large as the distances between points: fewer ones, on planes of many."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._scan._even_choice import even_choice

NEIGHBOURS = 16  # of a point, which tell its noise
NOISY = 0.1  # of the spacing: usual distance from their surface, from which on a mesh of all points fails
SHARES = 4, 16, 64  # points that a node stands for, tried one after the other
PER_NODE = 6  # times as many make the plane that a node is moved to
LEAST_NODES = 40
ENTRIES = 1 << 20  # neighbours at once


def is_noisy(points: Float[Any, "points 3"]) -> bool:
    """Whether distances from quadratic surfaces of neighbours are comparable to those from neighbours.

    From planes they are so on a bent sheet without noise, too.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    spacing = float(np.median(tree.query(points, 2)[0][:, 1]))
    near = points[tree.query(points, min(NEIGHBOURS, len(points)))[1]]
    steps = near - near.mean(axis=1, keepdims=True)
    frame = np.linalg.eigh(np.swapaxes(steps, 1, 2) @ steps)[1]
    height, x, y = np.moveaxis(steps @ frame, 2, 0)
    quadratic = np.linalg.qr(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2))[0]
    left = height - np.einsum("pik,pjk,pj->pi", quadratic, quadratic, height)
    return bool(np.median(np.abs(left[:, 0])) > NOISY * spacing)


def denoised_nodes(points: Float[Any, "points 3"]) -> Iterator[Float[Any, "nodes 3"]]:
    """About one node for 4 points, then one for 16 and so on."""
    for share in SHARES:
        if len(points) >= LEAST_NODES * share:
            moved = on_planes(points, PER_NODE * share)
            yield moved[even_choice(moved, len(points) // share)]


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
