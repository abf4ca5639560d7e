"""Loops of the sheet in the parameters of a surface: simple, and around the feet of its points."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._closest import closest_point
from jaxfit._scan._extras import import_shapely
from jaxfit._scan._manifold import Faces
from jaxfit._scan._sheet import Sheet
from jaxfit._splines import BSplineSurface

SMOOTHED = 0.5  # of the spacing: notches of the rim this narrow are closed
STRAIGHT = 0.02  # of the spacing: vertices this near to the line between others are dropped
LEAST_HOLE = 0.25  # times the squared hole length: smaller ones are gaps between triangles
LEAST_AREA = 1e-9  # of the mean: smaller triangles cover nothing
MOST_SINGLE = 0.75  # nodes for each point, above which the rim goes through points
LONGEST = 2.0  # times the spacing: longer edges are divided

Loop = Float[np.ndarray, "vertices 2"]


def trim_loops(
    surface: BSplineSurface,
    sheet: Sheet,
    sides: Float[Any, "2"],
    nodes: Float[Any, "nodes 2"],
    points: Float[Any, "kept 2"],
) -> tuple[Loop, ...]:
    """Closed polylines in (u, v), the rim first and counter-clockwise, holes clockwise.

    They bound the union of the mesh's triangles, their vertices at their feet: whatever noise does to single
    triangles, that is a region, and it holds the feet of all vertices. Its narrow notches and small gaps are
    closed. `nodes` and `points` are the feet of these.
    """
    shapely = import_shapely()
    low, high = np.asarray(surface.domain, float).T
    scale = sides / (high - low)  # (u, v) to about the lengths of the sheet
    region = _union((nodes - low) * scale, sheet.faces)
    outset = _outset(region, ((points - low) * scale)[sheet.on_sheet], len(nodes))
    reach, least = SMOOTHED * sheet.spacing, STRAIGHT * sheet.spacing
    region = _largest(region.buffer(reach).buffer(-reach).simplify(least).buffer(least + outset))
    region = _largest(region.intersection(shapely.box(0.0, 0.0, *sides)))
    smallest = LEAST_HOLE * (sheet.hole_length / sheet.size) ** 2
    holes = [x for x in region.interiors if shapely.Polygon(x).area > smallest]
    region = shapely.Polygon(region.exterior, holes).segmentize(LONGEST * sheet.spacing)
    region = shapely.orient_polygons(region)
    rings = [np.asarray(x.coords)[:-1] for x in (region.exterior, *region.interiors)]
    return tuple(np.clip(x / scale + low, low, high) for x in rings)


def _union(places: Float[Any, "nodes 2"], faces: Faces) -> Any:
    """The region that triangles cover, whichever way round they are."""
    shapely = import_shapely()
    corners = places[faces]
    triangles = shapely.polygons(corners)
    area = shapely.area(triangles)
    return _largest(shapely.union_all(triangles[area > LEAST_AREA * area.mean()]))


def _outset(region: Any, points: Float[Any, "some 2"], nodes: int) -> float:
    """How far the points reach beyond nodes that stand for several of them.

    They lie evenly in a strip around the nodes: half of them in its inner half.
    """
    if nodes > MOST_SINGLE * len(points):
        return 0.0
    shapely = import_shapely()
    shapely.prepare(region)
    outside = points[~shapely.contains_xy(region, *points.T)]
    if not len(outside):
        return 0.0
    return 2.0 * float(np.median(shapely.distance(region, shapely.points(outside))))


def node_feet(surface: BSplineSurface, sheet: Sheet, feet: Float[Any, "kept 2"]) -> Loop:
    """Of the nodes of the mesh, found from the feet of the points next to them."""
    from scipy.spatial import cKDTree

    some = np.flatnonzero(sheet.on_sheet)
    away, nearest = cKDTree(sheet.points[some]).query(sheet.nodes)
    found = feet[some[nearest]]
    rest = np.flatnonzero(away > 0)
    if len(rest):
        points = sheet.nodes[rest] * sheet.size + sheet.centre
        foot = closest_point(surface, points, start=(found[rest, 0], found[rest, 1]))
        found[rest] = np.stack([np.asarray(foot.u, float), np.asarray(foot.v, float)], axis=1)
    return found


def _largest(region: Any) -> Any:
    """The largest polygon of a region."""
    shapely = import_shapely()
    parts = [x for x in shapely.get_parts(region) if x.geom_type == "Polygon"]
    if not parts:
        raise ValueError(
            "points must have a rim that encloses an area of the surface, but it does not; pass a boundary."
        )
    return max(parts, key=lambda x: x.area)
