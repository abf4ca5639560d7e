"""Normals of scattered points: planes through neighbours, oriented along a spanning tree."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

PLANES = 3  # times the plane is laid; each time, steps out of the last one count less


def principal_axes(
    unit: Float[Any, "points width d"], weight: Float[Any, "points width"]
) -> Float[Any, "points d d"]:
    """Principal axes of the weighted unit directions to the neighbours, as columns, the normal first.

    Unit, so that a dense side does not outweigh a thin one by its distances.
    """
    cosine = 1.0
    for _ in range(PLANES):
        covariance = np.swapaxes(unit * (weight * cosine)[..., None], 1, 2) @ unit
        axes = np.linalg.eigh(covariance)[1]
        cosine = np.sum((unit @ axes[:, :, -2:]) ** 2, axis=2) ** 2
    return axes


def oriented(
    normals: Float[Any, "points 3"],
    unit: Float[Any, "points width 3"],
    members: Int[Any, "points width"],
    filled: Bool[Any, "points width"],
) -> Float[Any, "points 3"]:
    """The normals with signs that agree along a tree of steps within the surface.

    After Hoppe et al. (1992), but with the slope of a step against both planes in its cost: the
    tree goes round an edge from one sheet to the other rather than across the gap.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    count = len(normals)
    slope = np.abs(np.sum(unit * normals[:, None], axis=2))
    other = np.abs(np.sum(unit * normals[members], axis=2))
    deviation = 1 - np.abs(np.sum(normals[members] * normals[:, None], axis=2))
    cost = 1e-9 + np.maximum(slope, other) ** 2 + deviation
    rows = np.broadcast_to(np.arange(count)[:, None], members.shape)
    graph = csr_array((cost[filled], (rows[filled], members[filled])), shape=(count, count))
    tree = minimum_spanning_tree(graph)
    sign, seen = np.ones(count), np.zeros(count, bool)
    for root in range(count):
        if seen[root]:
            continue
        order, before = breadth_first_order(tree, root, directed=False)
        seen[order] = True
        for each in order[1:]:
            parent = before[each]
            agree = float(normals[each] @ normals[parent]) >= 0
            sign[each] = sign[parent] if agree else -sign[parent]
    return normals * sign[:, None]
