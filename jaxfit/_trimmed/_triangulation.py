"""Triangles of a region inside loops, fine enough for a surface over it.

Delaunay's triangulation of the loops' vertices and of a grid inside, refined until every edge of a loop is a
side of triangles and every side is near the surface. New vertices go halfway along what is to be refined; one
that would come too close to a loop refines the loop instead, which is Ruppert's rule.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._trimmed._checked_loops import Loop, edges_of
from jaxfit._trimmed._inside import inside_on_grid, inside_on_host

_MOST_ROUNDS = 60

Places = Float[np.ndarray, "_ 2"]
Segments = Int[np.ndarray, "_ 2"]
Triangles = Int[np.ndarray, "_ 3"]


def triangulate(
    points_at: Callable[[Places], Float[np.ndarray, "_ d"]],
    loops: list[Loop],
    grid: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]],
    tolerance: float,
    most: int,
) -> tuple[Places, Triangles]:
    """Vertices (u, v) and triangles, counter-clockwise, whose union is the region inside the loops.

    Parameters
    ----------
    points_at
        The surface. The distance of its point halfway along a side of a triangle from that side in space is
        at most `tolerance`.
    grid
        Lines of constant u and of constant v between which the surface has no turns.
    most
        Vertices after which there are no more rounds.

    Raises
    ------
    ValueError
        If the loops are too close to each other for triangles.
    """
    scale = _scale(points_at, grid)
    places, segments = _subdivided(loops, grid)
    edges = edges_of(loops)
    places = np.concatenate([places, _inner_grid(edges, grid, places, segments, scale)])
    for _ in range(_MOST_ROUNDS):
        triangles = _delaunay(places * scale)
        sides = _sides(triangles)
        split = ~_among(segments, sides, len(places))
        new = np.zeros((0, 2))
        if not split.any():
            triangles = triangles[inside_on_host(edges, places[triangles].mean(axis=1))]
            sides = _sides(triangles)
            far = _edges_off_surface(points_at, places, sides, tolerance)
            if not far.any() or len(places) >= most:
                return places, triangles
            split = _among(segments, sides[far], len(places))
            inner = sides[far][~_among(sides[far], segments, len(places))]
            new = places[inner].mean(axis=1)
            encroached, close = _encroached(new * scale, places[segments] * scale)
            split |= encroached
            new = new[~close]
        places, segments = _split(places, segments, split)
        places = np.concatenate([places, new])
    raise ValueError("loops must leave room for triangles between them, but do not; resample them coarser.")


def _scale(points_at: Any, grid: tuple[np.ndarray, np.ndarray]) -> Float[np.ndarray, "2"]:
    """Lengths on the surface for a unit of u, and of v, in the mean."""
    us, vs = (np.linspace(line[0], line[-1], 33) for line in grid)
    at = np.stack(np.meshgrid(us, vs, indexing="ij"), axis=-1)
    points = points_at(at.reshape(-1, 2)).reshape(*at.shape[:2], -1)
    lengths = [
        float(np.linalg.norm(np.diff(points, axis=k), axis=-1).sum(axis=k).mean() / np.ptp(line))
        for k, line in enumerate((us, vs))
    ]
    unit = max(lengths[0] * np.ptp(us), lengths[1] * np.ptp(vs)) or 1.0
    # A direction along which the surface has no extent must not collapse its triangles.
    least = [1e-3 / np.ptp(us), 1e-3 / np.ptp(vs)]
    return np.maximum(np.array(lengths) / unit, least)


def _subdivided(loops: list[Loop], grid: tuple[np.ndarray, np.ndarray]) -> tuple[Places, Segments]:
    """The loops with no edge longer than the distance between lines of the grid."""
    steps = np.array([np.median(np.diff(line)) for line in grid])
    places, segments, first = [], [], 0
    for loop in loops:
        along = np.roll(loop, -1, axis=0) - loop
        counts = np.maximum(1, np.ceil(np.max(np.abs(along) / steps, axis=1) - 1e-9)).astype(int)
        owner = np.repeat(np.arange(len(loop)), counts)
        share = (np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[owner]
        places.append(loop[owner] + share[:, None] * along[owner])
        index = first + np.arange(len(owner))
        segments.append(np.stack([index, np.roll(index, -1)], axis=1))
        first += len(owner)
    return np.concatenate(places), np.concatenate(segments)


def _inner_grid(edges: Any, grid: tuple, places: Places, segments: Segments, scale: np.ndarray) -> Places:
    """Crossings of the grid that are inside the loops, and outside the circles over their segments."""
    crossings = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1)
    inner = crossings[inside_on_grid(edges, *grid)]
    return inner[~_encroached(inner * scale, places[segments] * scale)[1]]


def _delaunay(places: Places) -> Triangles:
    """Delaunay's triangles in a frame of four far corners, so that none along the rim is degenerate."""
    from scipy.spatial import Delaunay

    low, high = places.min(axis=0), places.max(axis=0)
    middle, reach = 0.5 * (low + high), 2.0 * (high - low).max()
    corners = middle + reach * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    triangles = Delaunay(np.concatenate([places, corners]) - middle).simplices.astype(np.int64)
    return triangles[(triangles < len(places)).all(axis=1)]


def _sides(triangles: Triangles) -> Segments:
    """Each side once, its lower vertex first."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    count = int(pairs.max()) + 1
    # As single numbers, which sort ten times as fast as rows.
    return np.stack(np.divmod(np.unique(pairs @ np.array([count, 1])), count), axis=1)


def _among(pairs: Segments, others: Segments, count: int) -> Bool[np.ndarray, " _"]:
    """Which pairs of vertices, of `count`, are among others, in either order."""
    keys = [np.sort(x, axis=1) @ np.array([count, 1]) for x in (pairs, others)]
    return np.isin(*keys)


def _edges_off_surface(
    points_at: Any, places: Places, sides: Segments, tolerance: float
) -> Bool[np.ndarray, " _"]:
    """Whose chord is farther than the tolerance from the surface's point halfway along it."""
    points = points_at(places)
    start, end = points[sides[:, 0]], points[sides[:, 1]]
    side, gap = end - start, points_at(places[sides].mean(axis=1)) - start
    squared = np.maximum(np.sum(side * side, axis=1), np.finfo(float).tiny)
    along = np.clip(np.sum(side * gap, axis=1) / squared, 0.0, 1.0)
    return np.linalg.norm(gap - along[:, None] * side, axis=1) > tolerance


def _encroached(
    places: Places, segments: Float[np.ndarray, "segments 2 2"]
) -> tuple[Bool[np.ndarray, " segments"], Bool[np.ndarray, " _"]]:
    """Which segments have a place inside the circle over them, and which places are in such a circle."""
    some, close = np.zeros(len(segments), bool), np.zeros(len(places), bool)
    if not len(places):
        return some, close
    from scipy.spatial import cKDTree

    middles = segments.mean(axis=1)
    radii = 0.5 * np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    found = cKDTree(places).query_ball_point(middles, radii * (1 + 1e-9))
    for i, members in enumerate(found):
        if members:
            some[i] = True
            close[members] = True
    return some, close


def _split(places: Places, segments: Segments, which: Bool[np.ndarray, " _"]) -> tuple[Places, Segments]:
    """Cut segments in halves."""
    cut = segments[which]
    index = len(places) + np.arange(len(cut))
    halves = np.stack([cut[:, 0], index], axis=1), np.stack([index, cut[:, 1]], axis=1)
    return np.concatenate([places, places[cut].mean(axis=1)]), np.concatenate([segments[~which], *halves])
