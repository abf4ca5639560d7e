"""Faces of Open CASCADE from B-spline surfaces and loops."""

from typing import Any

import numpy as np

from jaxfit._trimmed._checked_loops import Loop, signed_area
from jaxfit.io._nets import ClampedNet
from jaxfit.io._trim_curves import TrimCurve, trim_curves

TOLERANCE = 1e-7  # of a modelling kernel, absolute
_LEAST_DIAGONAL = 1e-4  # a thousand tolerances
_LARGEST_DIAGONAL = 4e8  # there float64 numbers are about the tolerance apart
_CURVE_TOLERANCE = 1e-6  # of an edge in space from its line on the surface
_MOST_DEGREE, _MOST_SEGMENTS = 14, 1000  # of an edge in space


def face_of(net: ClampedNet, loops: list[Loop]) -> Any:
    """The surface inside the loops as a face; without loops the whole surface, bounded by its four sides.

    Edges are those of the loops, straight in (u, v), or cubic splines through many of their vertices.

    Raises
    ------
    ValueError
        If the surface is too small or too large for the tolerance of the kernel, or it makes no valid face;
        if a loop runs along both sides of a seam, or along a side that is a point.
    """
    from OCP.BRepCheck import BRepCheck_Analyzer

    if not net.diagonal >= _LEAST_DIAGONAL:
        raise ValueError(
            f"surface must be at least {_LEAST_DIAGONAL:g} across for STEP and IGES, whose readers take "
            f"points closer than {TOLERANCE:g} for one, but is {net.diagonal:.3g}; use a smaller unit."
        )
    if not net.diagonal <= _LARGEST_DIAGONAL:
        raise ValueError(
            f"surface must be at most {_LARGEST_DIAGONAL:g} across for STEP and IGES, whose readers tell "
            f"points {TOLERANCE:g} apart, but is {net.diagonal:.3g}; use a larger unit."
        )
    if loops and not _are_the_border(net, loops):
        _check_sides(net, loops)
        face = _trimmed(net, loops)
    else:
        face = _whole(net)
    if face is None or not BRepCheck_Analyzer(face).IsValid():
        raise ValueError(
            "surface must make a valid face, but Open CASCADE finds that it does not; write .3dm or .json."
        )
    return face


def _are_the_border(net: ClampedNet, loops: list[Loop]) -> bool:
    """Whether there is but one loop, around the whole domain."""
    (low_u, high_u), (low_v, high_v) = net.domain
    whole = (high_u - low_u) * (high_v - low_v)
    return len(loops) == 1 and signed_area(loops[0]) >= whole * (1 - 1e-12)


def _check_sides(net: ClampedNet, loops: list[Loop]) -> None:
    """Refuse edges that would coincide in space or be points there: the face in the file would be empty."""
    for axis, (low, high) in enumerate(net.domain):
        sides = np.moveaxis(net.control_points, axis, 0)[[0, -1]]
        points = np.ptp(sides, axis=1).max(axis=1) <= TOLERANCE
        closed = np.abs(sides[1] - sides[0]).max() <= TOLERANCE
        along = [
            any(((loop[:, axis] == at) & (np.roll(loop, 1, axis=0)[:, axis] == at)).any() for loop in loops)
            for at in (low, high)
        ]
        if (closed and all(along)) or (points & along).any():
            which = "both sides of a seam" if closed else "a side that is a point in space"
            raise ValueError(
                f"loops must not run along {which} for STEP and IGES, but do along {'uv'[axis]}; end them a "
                "little before it, or write .3dm or .json."
            )


def _whole(net: ClampedNet) -> Any:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace

    maker = BRepBuilderAPI_MakeFace(_geometry(net), TOLERANCE)
    return maker.Face() if maker.IsDone() else None


def _trimmed(net: ClampedNet, loops: list[Loop]) -> Any:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.BRepLib import BRepLib
    from OCP.GeomAbs import GeomAbs_Shape

    surface = _geometry(net)
    apart = [_apart(surface, loop) for loop in loops]
    wires = [_wire(surface, curves) for curves in trim_curves(apart, np.array(net.domain))]
    if any(wire is None for wire in wires):
        return None
    maker = BRepBuilderAPI_MakeFace(surface, wires[0], True)
    for wire in wires[1:]:
        maker.Add(wire)
    if not maker.IsDone():
        return None
    face = maker.Face()
    # With the defaults edges in space may leave the surface by far more than the tolerance.
    tolerance = max(_CURVE_TOLERANCE, 0.1 * TOLERANCE * net.diagonal)
    BRepLib.BuildCurves3d_s(face, tolerance, GeomAbs_Shape.GeomAbs_C2, _MOST_DEGREE, _MOST_SEGMENTS)
    BRepLib.SameParameter_s(face, tolerance, False)
    return face


def _wire(surface: Any, curves: list[TrimCurve]) -> Any:
    """A closed wire of edges along curves in (u, v), which meet in common vertices."""
    from OCP.BRepBuilderAPI import (
        BRepBuilderAPI_MakeEdge,
        BRepBuilderAPI_MakeVertex,
        BRepBuilderAPI_MakeWire,
    )

    starts = [surface.Value(*curve.control_points[0].tolist()) for curve in curves]
    vertices = [BRepBuilderAPI_MakeVertex(point).Vertex() for point in starts]
    maker = BRepBuilderAPI_MakeWire()
    for i, curve in enumerate(curves):
        ends = vertices[i], vertices[(i + 1) % len(vertices)]
        first, last = float(curve.knots[0]), float(curve.knots[-1])
        edge = BRepBuilderAPI_MakeEdge(_plane_curve(curve), surface, *ends, first, last)
        if not edge.IsDone():
            return None
        maker.Add(edge.Edge())
    return maker.Wire() if maker.IsDone() else None


def _plane_curve(curve: TrimCurve) -> Any:
    from OCP.collections import Array1_double, Array1_gp_Pnt2d, Array1_int
    from OCP.Geom2d import Geom2d_BSplineCurve, Geom2d_Line
    from OCP.gp import gp_Dir2d, gp_Pnt2d

    points = [gp_Pnt2d(*point) for point in curve.control_points.tolist()]
    if curve.degree == 1:
        along = curve.control_points[1] - curve.control_points[0]
        return Geom2d_Line(points[0], gp_Dir2d(*along.tolist()))
    values, counts = np.unique(curve.knots, return_counts=True)
    knots, repeats = _filled(Array1_double, values.tolist()), _filled(Array1_int, counts.tolist())
    return Geom2d_BSplineCurve(_filled(Array1_gp_Pnt2d, points), knots, repeats, curve.degree)


def _apart(surface: Any, loop: Loop) -> Loop:
    """The loop without vertices that the kernel would take for the one before."""
    points = np.array([(p.X(), p.Y(), p.Z()) for p in (surface.Value(u, v) for u, v in loop.tolist())])
    kept = [0]
    for i in range(1, len(points)):
        if min(np.linalg.norm(points[i] - points[k]) for k in (0, kept[-1])) > 4 * TOLERANCE:
            kept.append(i)
    if len(kept) < 3:
        raise ValueError(
            f"loops must be larger than {TOLERANCE:g} for STEP and IGES, but one is not; leave it out, or "
            "use a smaller unit."
        )
    return loop[kept]


def _geometry(net: ClampedNet) -> Any:
    from OCP.collections import Array1_double, Array1_int, Array2_gp_Pnt
    from OCP.Geom import Geom_BSplineSurface
    from OCP.gp import gp_Pnt

    nu, nv, _ = net.control_points.shape
    points = Array2_gp_Pnt(1, nu, 1, nv)
    for i, row in enumerate(net.control_points.tolist(), start=1):
        for j, point in enumerate(row, start=1):
            points.SetValue(i, j, gp_Pnt(*point))
    knots, repeats = [], []
    for vector in (net.knots_u, net.knots_v):
        values, counts = np.unique(vector, return_counts=True)
        knots.append(_filled(Array1_double, values.tolist()))
        repeats.append(_filled(Array1_int, counts.tolist()))
    return Geom_BSplineSurface(points, *knots, *repeats, *(order - 1 for order in net.order))


def _filled(kind: Any, values: list[Any]) -> Any:
    array = kind(1, len(values))
    for i, value in enumerate(values, start=1):
        array.SetValue(i, value)
    return array
