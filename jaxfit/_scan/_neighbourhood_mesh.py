"""A mesh of scattered points in space: triangles on which the Delaunay stars of their corners agree."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit._base import Planes, Stars, share_on_circles, stars, supported_planes
from jaxfit._scan._bridges import without_bridges
from jaxfit._scan._manifold import Faces, longest_edges, manifold

PLANE_NEIGHBOURS = 16  # of a point, that make its tangent plane
NEIGHBOURS = 24  # among which its star is searched: near another sheet some are on that
ALIKE = 0.5  # least cosine between normals of corners that are surely on one sheet
STRAIGHT = 2e-2  # sine of an angle of a star's hull: points of a grid of whole numbers are on a circle still,
GRID = 0.25  # and where so many stars have a point on a circle, points make a grid; at random 0.17 have
WIDEST = 0.99 * np.pi  # a larger angle between two neighbours is a gap


def neighbourhood_mesh(
    points: Float[Any, "points 3"], length: float, least_votes: int = 2, on_lines: bool = False
) -> Faces:
    """Oriented triangles between the points, without edges longer than `length`.

    Every point has its Delaunay star in its own tangent plane, so that walls and overhangs are as good as
    flat parts. A triangle is in the stars of all of its three corners where these agree. Those in all three
    come first, then those in at least `least_votes` that fit in between, the shortest first. Among noise
    triangles in one star make bridges. On a grid, or where points are `on_lines`, stars disagree on diagonals
    where the sheet bends, and those are taken that fill a notch. Triangles between corners whose normals
    differ much come last: they may join sheets that face each other.
    """
    planes = supported_planes(points, PLANE_NEIGHBOURS)
    star, is_grid = _stars(planes)
    faces, votes = _candidates(star)
    longest = longest_edges(points, faces)
    short = longest <= length
    faces, votes, longest = faces[short], votes[short], longest[short]
    assert planes.normals is not None
    corners = planes.normals[faces]
    unlike = (np.sum(corners * np.roll(corners, 1, axis=1), axis=2) < ALIKE).any(axis=1)
    order = np.lexsort((longest, -votes, unlike))
    faces, agreed = _oriented(points, planes.normals, faces[order]), votes[order] >= least_votes
    found = manifold(faces[agreed], faces[~agreed] if is_grid or on_lines else None)
    return without_bridges(points, planes.normals, found)


def _stars(planes: Planes) -> tuple[Stars, bool]:
    """The stars, and whether the points make a grid.

    On a bent grid the corners of a square would disagree on its diagonal, each in its own plane: there all
    four see both, of which the shorter one is taken.
    """
    count = len(planes.points)
    wide = stars(planes.points, NEIGHBOURS, fixed=count, planes=planes, straight=STRAIGHT)
    if share_on_circles(wide, STRAIGHT) > GRID:
        return wide, True
    return stars(planes.points, NEIGHBOURS, fixed=count, planes=planes), False


def _candidates(star: Stars) -> tuple[Faces, Int[np.ndarray, " faces"]]:
    """All triangles of all stars, and in how many stars each is."""
    count = star.filled.sum(axis=1, keepdims=True)
    following = (np.arange(star.members.shape[1])[None] + 1) % np.maximum(count, 1)
    after = np.take_along_axis(star.members, following, axis=1)
    closed = star.filled & (star.angle < WIDEST) & (count > 2)
    own = np.broadcast_to(np.arange(len(star.members))[:, None], star.members.shape)
    corners = np.stack([own[closed], star.members[closed], after[closed]], axis=1)
    faces, votes = np.unique(np.sort(corners, axis=1), axis=0, return_counts=True)
    return faces, votes


def _oriented(points: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> Faces:
    """The triangles, each turned so that its normal agrees with those of its corners."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    up = np.sum(np.cross(b - a, c - a) * normals[faces].sum(axis=1), axis=1) > 0
    return np.where(up[:, None], faces, faces[:, [0, 2, 1]])
