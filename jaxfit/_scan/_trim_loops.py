"""Loops of the sheet in the parameters of a surface: simple, and around the feet of its points."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._closest import closest_point
from jaxfit._scan._extras import import_shapely
from jaxfit._scan._sheet import Sheet
from jaxfit._splines import BSplineSurface

SMOOTHED = 0.5  # of the spacing: notches of the rim this narrow are closed
STRAIGHT = 0.02  # of the spacing: vertices this near to the line between others are dropped
LONGEST = 2.0  # times the spacing: longer edges are divided

Loop = Float[np.ndarray, "vertices 2"]


def trim_loops(
    surface: BSplineSurface, sheet: Sheet, feet: Float[Any, "kept 2"]
) -> tuple[Loop, ...]:
    """Closed polylines in (u, v), the rim first and counter-clockwise, holes clockwise.

    The feet of the vertices around the mesh make a polygon. It is repaired where it crosses itself, grows
    into its narrow notches, and never shrinks, so that the points on the rim stay inside.
    """
    shapely = import_shapely()
    low, high = np.asarray(surface.domain, float).T
    scale = sheet.sides / (high - low)  # (u, v) to about the lengths of the sheet
    rings = [(x - low) * scale for x in _loop_feet(surface, sheet, feet)]
    region = _largest(shapely.Polygon(rings[0]).buffer(0))
    for ring in rings[1:]:
        region = _largest(region.difference(shapely.Polygon(ring).buffer(0)))
    reach, least = SMOOTHED * sheet.spacing, STRAIGHT * sheet.spacing
    region = _largest(region.buffer(reach).buffer(-reach).simplify(least).buffer(least + sheet.outset))
    box = shapely.box(0.0, 0.0, *sheet.sides)
    region = _largest(region.intersection(box)).segmentize(LONGEST * sheet.spacing)
    region = shapely.orient_polygons(region)
    rings = [np.asarray(x.coords)[:-1] for x in (region.exterior, *region.interiors)]
    return tuple(np.clip(x / scale + low, low, high) for x in rings)


def _loop_feet(surface: BSplineSurface, sheet: Sheet, feet: Float[Any, "kept 2"]) -> list[Loop]:
    """Of the nodes around the sheet, found from the feet of the points next to them."""
    from scipy.spatial import cKDTree

    nodes = sheet.nodes[np.concatenate(sheet.loops)]
    some = np.flatnonzero(sheet.on_sheet)
    start = feet[some[cKDTree(sheet.points[some]).query(nodes)[1]]]
    found = closest_point(surface, nodes * sheet.size + sheet.centre, start=(start[:, 0], start[:, 1]))
    both = np.stack([np.asarray(found.u, float), np.asarray(found.v, float)], axis=1)
    return np.split(both, np.cumsum([len(x) for x in sheet.loops])[:-1])


def _largest(region: Any) -> Any:
    """The largest polygon of a region."""
    shapely = import_shapely()
    parts = [x for x in shapely.get_parts(region) if x.geom_type == "Polygon"]
    if not parts:
        raise ValueError(
            "points must have a rim that encloses an area of the surface, but it does not; pass a boundary."
        )
    return max(parts, key=lambda x: x.area)
