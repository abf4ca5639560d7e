"""A coarser mesh of given triangles: one node for each region of vertices, however near other sheets are."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit._scan._manifold import Faces, directed_edges, manifold


def coarse_faces(
    points: Float[Any, "points 3"], faces: Faces, nodes: Int[Any, " nodes"]
) -> tuple[Int[np.ndarray, "_ 3"], Int[np.ndarray, " points"]]:
    """Triangles between some of the points, and the node of every point, -1 for none; as places in `nodes`.

    Each vertex belongs to the node that is nearest along the edges of the mesh. Where three regions meet in a
    triangle, their nodes make one: the dual of a Voronoi diagram within the surface.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    ends = np.unique(np.sort(directed_edges(faces), axis=1), axis=0)
    length = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
    graph = csr_array((length, tuple(ends.T)), shape=(len(points), len(points)))
    found = dijkstra(graph, directed=False, indices=nodes, min_only=True, return_predecessors=True)[2]
    number = np.full(len(points), -1)
    number[nodes] = np.arange(len(nodes))
    region = np.where(found >= 0, number[np.maximum(found, 0)], -1)
    corners = region[faces]
    apart = (corners >= 0).all(axis=1) & (np.diff(np.sort(corners, axis=1), axis=1) > 0).all(axis=1)
    corners = corners[apart]
    _, first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    return manifold(corners[np.sort(first)]), region
