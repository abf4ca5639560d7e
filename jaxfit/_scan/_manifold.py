"""Oriented triangles that make a surface: every edge twice at most, one fan at each vertex."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

Faces = Int[Any, "_ 3"]


def manifold(candidates: Faces, ears: Faces | None = None) -> Faces:
    """The oriented triangles, taken greedily in the order given, that make a 2-manifold with boundary.

    A triangle whose directed edge is taken already lies on the same side of that edge as another one, so it
    is passed over: neighbouring triangles of an oriented surface run along their edge in opposite directions.
    Of the `ears` those are taken after all others that have two or three edges on the boundary.
    """
    taken: set[tuple[int, int]] = set()
    found = _added(candidates.tolist(), taken, 0)
    rest = [] if ears is None else ears.tolist()
    while more := _added(rest, taken, 2):
        found += more
    return single_fans(np.asarray(found, int).reshape(-1, 3))


def _added(candidates: list[list[int]], taken: set[tuple[int, int]], shared: int) -> list[list[int]]:
    """Candidates none of whose edges is taken, and `shared` of them the other way round; these are then."""
    added = []
    for face in candidates:
        a, b, c = face
        edges = ((a, b), (b, c), (c, a))
        if taken.isdisjoint(edges) and sum((y, x) in taken for x, y in edges) >= shared:
            taken.update(edges)
            added.append(face)
    return added


def single_fans(faces: Faces) -> Faces:
    """Without all but the largest fan of triangles at each vertex."""
    while len(faces):
        fan = fans(faces)
        sizes = np.bincount(fan.ravel())
        owner = np.empty(len(sizes), int)
        owner[fan.ravel()] = faces.ravel()
        order = np.lexsort((sizes, owner))
        largest = np.zeros(len(sizes), bool)
        largest[order[np.append(np.diff(owner[order]) != 0, True)]] = True
        good = largest[fan].all(axis=1)
        if good.all():
            break
        faces = faces[good]
    return faces


def fans(faces: Faces) -> Int[Any, "_ 3"]:
    """For each corner of each triangle the number of the fan around its vertex: corners of triangles that
    share an edge at the vertex are of one fan."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    here, there = adjacent(faces)
    corner = np.arange(faces.size).reshape(-1, 3)
    (f, i), (g, j) = np.divmod(here, 3), np.divmod(there, 3)
    # Edge i runs from corner i to corner i + 1; in the other triangle it runs back.
    first = np.concatenate([corner[f, i], corner[f, (i + 1) % 3]])
    second = np.concatenate([corner[g, (j + 1) % 3], corner[g, j]])
    graph = csr_array((np.ones(len(first)), (first, second)), shape=(faces.size, faces.size))
    return connected_components(graph, directed=False)[1].reshape(-1, 3)


def directed_edges(faces: Faces) -> Int[Any, "edges 2"]:
    """Edge 3 f + i runs from corner i of triangle f to the next corner."""
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)


def euler(faces: Faces) -> int:
    """Vertices less edges plus triangles: 2 less the boundary loops and twice the handles of one piece."""
    edges, count = np.sort(directed_edges(faces), axis=1), int(faces.max()) + 1
    return len(np.unique(faces)) - len(np.unique(edges[:, 0] * count + edges[:, 1])) + len(faces)


def adjacent(faces: Faces) -> tuple[Int[Any, " pairs"], Int[Any, " pairs"]]:
    """Numbers of directed edges, 3 f + i, and of those that run back along them."""
    edges = directed_edges(faces)
    count = int(faces.max()) + 1 if len(faces) else 1
    forth, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    order = np.argsort(forth)
    place = np.minimum(np.searchsorted(forth[order], back), len(order) - 1)
    found = forth[order[place]] == back
    return np.flatnonzero(found), order[place[found]]


def pieces(faces: Faces) -> Int[Any, " faces"]:
    """The number of the connected piece of each triangle, the one with most triangles first."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    here, there = adjacent(faces)
    graph = csr_array((np.ones(len(here)), (here // 3, there // 3)), shape=(len(faces), len(faces)))
    _, piece = connected_components(graph, directed=False)
    rank = np.argsort(np.argsort(-np.bincount(piece), kind="stable"), kind="stable")
    return rank[piece]


def boundary_loops(faces: Faces) -> list[Int[np.ndarray, " _"]]:
    """The closed polygons of vertices around a manifold, against the direction of its triangles' edges
    reversed: the surface lies to the left of each."""
    edges = directed_edges(faces)
    inside = np.zeros(len(edges), bool)
    inside[adjacent(faces)[0]] = True
    following = dict(edges[~inside].tolist())
    loops = []
    while following:
        start, at = following.popitem()
        loop = [start]
        while at != start:
            loop.append(at)
            at = following.pop(at)
        loops.append(np.asarray(loop))
    return loops


def areas(points: Float[Any, "points 3"], faces: Faces) -> Float[Any, " faces"]:
    """Of the triangles."""
    return np.linalg.norm(_crosses(points, faces), axis=1) / 2


def _crosses(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def vector_area(loop: Float[Any, "loop 3"]) -> Float[Any, "3"]:
    """Half the integral of r x dr around a closed polygon."""
    middle = loop - loop.mean(axis=0)
    return np.cross(middle, np.roll(middle, -1, axis=0)).sum(axis=0) / 2


def perimeter(loop: Float[Any, "loop d"]) -> float:
    """Of a closed polygon."""
    return float(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum())


def longest_edges(points: Float[Any, "points 3"], faces: Faces) -> Float[Any, " faces"]:
    """The length of the longest edge of each triangle."""
    corners = points[faces]
    return np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)


def in_use(faces: Faces, count: int) -> Bool[np.ndarray, " count"]:
    """Which of `count` vertices the triangles have."""
    used = np.zeros(count, bool)
    used[faces] = True
    return used
