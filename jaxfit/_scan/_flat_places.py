"""Places in the plane for the vertices of a sheet, and the rectangle around them."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit._scan._convex_map import circle_map
from jaxfit._scan._extras import import_shapely
from jaxfit._scan._isometric_map import isometric_maps, rest_triangles
from jaxfit._scan._manifold import Faces

HOLE_SHARE = 0.05  # of its area, by which a triangle across a hole resists distortion


def flat_places(
    points: Float[Any, "points 3"], faces: Faces, loops: list[Int[np.ndarray, " _"]]
) -> Float[np.ndarray, "points 2"]:
    """Places with little distortion and without flipped triangles, from the mesh alone.

    Each hole is closed by a vertex in its middle. The rim starts on a circle and is then free.
    """
    rim, holes = loops[0], loops[1:]
    middles = [points[x].mean(axis=0) for x in holes]
    caps = [
        np.stack([np.roll(x, -1), x, np.full(len(x), len(points) + k)], axis=1) for k, x in enumerate(holes)
    ]
    vertices = np.concatenate([points, np.reshape(middles, (-1, 3))])
    closed = np.concatenate([faces, *caps])
    share = np.where(np.arange(len(closed)) < len(faces), 1.0, HOLE_SHARE)
    places = circle_map(vertices, closed, rim)
    best = places
    for trial in isometric_maps(rest_triangles(vertices, closed, share), places):
        best = trial if _is_simple(trial[rim]) else best
    return best[: len(points)]


def _is_simple(loop: Float[np.ndarray, "_ 2"]) -> bool:
    return bool(import_shapely().LinearRing(loop).is_simple)


class Rectangle(NamedTuple):
    """The frame of a rectangle: places @ axes.T - corner lie within its sides."""

    axes: Float[np.ndarray, "2 2"]
    corner: Float[np.ndarray, "2"]
    sides: Float[np.ndarray, "2"]


def rectangle_around(places: Float[Any, "points 2"]) -> Rectangle:
    """The smallest rectangle around the places, its longer side along u."""
    from scipy.spatial import ConvexHull

    hull = places[ConvexHull(places).vertices]
    edges = np.roll(hull, -1, axis=0) - hull
    along = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)
    turned = hull @ np.swapaxes(axes, 1, 2)
    extents = np.ptp(turned, axis=1)
    best = int(np.argmin(np.prod(extents, axis=1)))
    frame, low, extent = axes[best], turned[best].min(axis=0), extents[best]
    if extent[1] > extent[0]:
        turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
        frame = turn @ frame
        low, extent = (hull @ frame.T).min(axis=0), extent[::-1]
    return Rectangle(frame, low, extent)
