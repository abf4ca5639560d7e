"""Gaps of a mesh that are narrower than a hole are closed with triangles."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._scan._manifold import Faces, boundary_loops, directed_edges, perimeter

MOST_CORNERS = 40  # of a gap


def with_gaps_closed(points: Float[Any, "points 3"], faces: Faces, length: float) -> Faces:
    """With triangles over every gap that can be closed without an edge longer than `length`.

    The longest loop is the rim and stays.
    """
    loops = boundary_loops(faces)
    if not loops:
        return faces
    rim = max(range(len(loops)), key=lambda k: perimeter(points[loops[k]]))
    edges = {tuple(sorted(x)) for x in directed_edges(faces).tolist()}
    added = []
    for k, loop in enumerate(loops):
        if k == rim or len(loop) > MOST_CORNERS:
            continue
        patch = _patch(points, loop[::-1].tolist(), length, edges)
        edges |= {tuple(sorted(x)) for x in directed_edges(np.asarray(patch, int).reshape(-1, 3)).tolist()}
        added += patch
    return np.concatenate([faces, np.asarray(added, int).reshape(-1, 3)])


def _patch(points: np.ndarray, loop: list[int], length: float, edges: set[Any]) -> list[list[int]]:
    """Triangles over the loop, cutting off the corner with the shortest new edge each time; none at all where
    an edge would be too long or is there already."""
    patch = []
    while len(loop) > 3:
        best, shortest = None, length
        for k in range(len(loop)):
            before, after = loop[k - 1], loop[(k + 1) % len(loop)]
            across = float(np.linalg.norm(points[after] - points[before]))
            if across <= shortest and (min(before, after), max(before, after)) not in edges:
                best, shortest = k, across
        if best is None:
            return []
        patch.append([loop[best - 1], loop[best], loop[(best + 1) % len(loop)]])
        loop = loop[:best] + loop[best + 1 :]
    return [*patch, loop]
