"""Nodes for clouds far denser along their scan lines than across: the nearest points are all on one line.

A plane through them may turn round that line, so that no mesh of all points joins one line with the next.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._scan._even_choice import even_choice

NEIGHBOURS = 16, 64, 256  # of a point: more of them are on a line that is itself several points wide
NARROW = 0.35  # where their spread across it is so small a part of that along it,
# and the cloud is on lines where as many of its points are. Planes across its rim turn round a line first.
NARROW_SHARE = 0.05
ENOUGH = 2000  # points to tell
# Points between nodes are nearer to one than BEYOND times what MOST_BETWEEN of all points are.
MOST_BETWEEN, BEYOND = 0.9, 1.2
PART = 8  # neighbours are at most one in so many points, or they are no neighbours


def thinned_along_lines(points: Float[Any, "points 3"]) -> Float[Any, "nodes 3"]:
    """Of points on lines so few, evenly chosen, that neighbours are on several lines; of others all.

    Where they never are, the sheet is a strip, as narrow as the lines would be.
    """
    nodes = points
    while on_lines(nodes):
        nodes = nodes[even_choice(nodes, len(nodes) // 2)]
        if len(nodes) <= PART * NEIGHBOURS[0]:
            return points
    return nodes if len(nodes) == len(points) else _to_the_ends(nodes, points)


def _to_the_ends(nodes: Float[Any, "nodes 3"], points: Float[Any, "points 3"]) -> Float[Any, "more 3"]:
    """With the last point of every line that the nodes stop short of, which a rim through them would cut off:
    of the points that are far from every node, the farthest of those that one node is nearest to.
    """
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(nodes).query(points)
    far = np.flatnonzero(distance > BEYOND * np.quantile(distance, MOST_BETWEEN))
    far = far[np.lexsort((-distance[far], nearest[far]))]
    return np.concatenate([nodes, points[far[np.unique(nearest[far], return_index=True)[1]]]])


def on_lines(points: Float[Any, "points 3"]) -> bool:
    """Whether the neighbours of many points lie along a line."""
    from scipy.spatial import cKDTree

    tree, some = cKDTree(points), points[:: -(-len(points) // ENOUGH)]
    return any(
        _narrow_share(points[tree.query(some, count + 1)[1]]) > NARROW_SHARE
        for count in NEIGHBOURS
        if count < len(points) / PART
    )


def _narrow_share(near: Float[Any, "some near 3"]) -> float:
    steps = near - near.mean(axis=1, keepdims=True)
    squares = np.linalg.eigvalsh(np.swapaxes(steps, 1, 2) @ steps)
    return float((squares[:, 1] < NARROW**2 * squares[:, 2]).mean())
