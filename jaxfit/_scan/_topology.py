"""Whether a mesh is a sheet: one piece, a disc with or without holes."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit._scan._manifold import (
    Faces,
    areas,
    boundary_loops,
    euler,
    perimeter,
    pieces,
    vector_area,
)

COMPARABLE = 0.1  # of the area of the largest piece: a second one is no stray
FEW = 0.05  # of the triangles of the piece that has most
LEAST_OPENING = 0.1  # of the perimeter of a flat disc of this area: a shorter rim is a gap in a sphere
TUBE_ENDS = 0.5  # least ratio of the areas of two loops that may be the ends of a tube
TUBE_AREA = 2.0  # least area of a tube, times the difference of these
REMEDY = "cut the points and fit the parts"


class TornMeshError(ValueError):
    """A mesh that noise may have torn or tied together."""


def largest_piece(points: Float[Any, "points 3"], faces: Faces) -> Faces:
    """The triangles of the largest piece; raises ValueError if there is another of comparable size.

    Pieces of few triangles count for nothing, however large these are: some points at a wrong level.
    """
    if not len(faces):
        raise ValueError(
            "points must be dense enough to tell their neighbours, but no triangles could be made of them; "
            "give more points, a boundary, or a larger hole_length."
        )
    piece = pieces(faces)
    many = np.bincount(piece) > FEW * np.bincount(piece).max()
    area = np.where(many, np.bincount(piece, areas(points, faces)), 0.0)
    largest = int(np.argmax(area))
    second = float(np.sort(area)[-2]) if len(area) > 1 else 0.0
    if second > COMPARABLE * area[largest]:
        raise ValueError(
            f"points must make one sheet, but make several pieces, the second with "
            f"{second / area[largest]:.0%} of the area of the first; fit each on its own, "
            "or raise hole_length to bridge the gap."
        )
    return faces[piece == largest]


def sheet_loops(points: Float[Any, "points 3"], faces: Faces) -> list[Int[np.ndarray, " _"]]:
    """The boundary loops of one piece, the rim first; raises ValueError if it is no disc with holes."""
    loops = sorted(boundary_loops(faces), key=lambda x: -perimeter(points[x]))
    area = float(areas(points, faces).sum())
    rim = perimeter(points[loops[0]]) if loops else 0.0
    if rim < LEAST_OPENING * np.sqrt(4 * np.pi * area):
        raise ValueError(
            f"points must make a sheet with a rim, but their surface is closed like a sphere; {REMEDY}."
        )
    characteristic = euler(faces)
    handles = (2 - len(loops) - characteristic) // 2
    if handles > 0:
        raise TornMeshError(
            f"points must make a disc with or without holes, but their surface has {handles} "
            f"handle{'s' * (handles != 1)} (Euler characteristic {characteristic}, {len(loops)} boundary "
            f"loops); {REMEDY}, or lower hole_length so that no bridge is made across a gap."
        )
    _check_no_tube(points, loops, area)
    return loops


def _check_no_tube(points: np.ndarray, loops: list[np.ndarray], area: float) -> None:
    """The ends of a tube enclose about the same area, which that between them has nothing to do with."""
    if len(loops) < 2:
        return
    rim, hole = (float(np.linalg.norm(vector_area(points[x]))) for x in loops[:2])
    small, large = sorted((rim, hole))
    if small > TUBE_ENDS * large and area > TUBE_AREA * (large - small):
        raise ValueError(
            "points must make a sheet that can be laid out flat, but their surface runs round like a tube; "
            "cut it open along a line from one end to the other, lower hole_length if it has a gap there, or "
            "fit parts."
        )
