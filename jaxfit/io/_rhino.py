"""Rhino's .3dm files, by rhino3dm."""

import base64
import importlib
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._trimmed._checked_loops import Loop, edges_of
from jaxfit._trimmed._quadrature import cut_at_lines
from jaxfit.io._nets import ClampedNet

_MOST_DEGREE = 11  # of curves in Rhino


def rhino_bytes(net: ClampedNet, loops: list[Loop], name: str) -> bytes:
    """The surface in a .3dm file, to the last bit; without a unit, since the surface has none.

    rhino3dm cannot trim a surface. Loops are closed curves on it, which Rhino's command Trim takes.

    Raises
    ------
    ValueError
        If rhino3dm finds the surface or a curve invalid.
    """
    rhino3dm: Any = importlib.import_module("rhino3dm")
    nu, nv, _ = net.control_points.shape
    surface = rhino3dm.NurbsSurface.Create(3, False, *net.order, nu, nv)
    for knots, target in ((net.knots_u, surface.KnotsU), (net.knots_v, surface.KnotsV)):
        for i, knot in enumerate(knots[1:-1].tolist()):  # openNURBS keeps neither the first nor the last
            target[i] = knot
    for i, row in enumerate(net.control_points.tolist()):
        for j, point in enumerate(row):
            surface.Points[i, j] = rhino3dm.Point4d(*point, 1.0)
    curves = [_curve(rhino3dm, _image(net, loop)) for loop in loops]
    if not all(item.IsValid for item in (surface, *curves)):
        raise ValueError("surface must be valid in .3dm files, but rhino3dm finds it is not; write .json.")
    model = rhino3dm.File3dm()
    model.Settings.ModelUnitSystem = getattr(rhino3dm.UnitSystem, "None")
    model.Objects.AddSurface(surface, _named(rhino3dm, name))
    for i, curve in enumerate(curves):
        which = f"hole {i}" if i else "outer loop"
        model.Objects.AddCurve(curve, _named(rhino3dm, f"{name}: {which}"))
    return base64.b64decode(model.Encode())


def _named(rhino3dm: Any, name: str) -> Any:
    attributes = rhino3dm.ObjectAttributes()
    attributes.Name = name
    return attributes


def _curve(rhino3dm: Any, pieces: Float[np.ndarray, "pieces count 3"]) -> Any:
    """Bezier pieces, end to end, as one curve."""
    degree = pieces.shape[1] - 1
    points = [*pieces[:, :-1].reshape(-1, 3).tolist(), pieces[-1, -1].tolist()]
    curve = rhino3dm.NurbsCurve(3, False, degree + 1, len(points))
    for i, knot in enumerate(np.repeat(np.arange(len(pieces) + 1.0), degree).tolist()):
        curve.Knots[i] = knot
    for i, point in enumerate(points):
        curve.Points[i] = rhino3dm.Point4d(*point, 1.0)
    return curve


def _image(net: ClampedNet, loop: Loop) -> Float[np.ndarray, "pieces count 3"]:
    """Control points of the Bezier pieces of a loop on the surface, in order along it.

    A line in one cell is a polynomial there, of degree K + L - 2; where Rhino takes no such degree, it is
    interpolated.
    """
    from scipy.interpolate import NdBSpline
    from scipy.special import comb

    start, end = cut_at_lines(edges_of([loop]), np.unique(net.knots_u), np.unique(net.knots_v))
    degree = min(sum(net.order) - 2, _MOST_DEGREE)
    at = 0.5 - 0.5 * np.cos(np.pi * np.arange(degree + 1) / degree)
    places = start[:, None, :] + at[:, None] * (end - start)[:, None, :]
    spline = NdBSpline((net.knots_u, net.knots_v), net.control_points, tuple(k - 1 for k in net.order))
    power = np.arange(degree + 1)
    bernstein = comb(degree, power) * at[:, None] ** power * (1 - at[:, None]) ** (degree - power)
    return np.linalg.solve(bernstein, np.asarray(spline(places)))
