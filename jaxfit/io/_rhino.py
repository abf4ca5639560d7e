"""Rhino's .3dm files, by rhino3dm."""

import base64
import importlib
from typing import Any

from jaxfit.io._nets import ClampedNet


def rhino_file(net: ClampedNet, name: str) -> bytes:
    """The surface in a .3dm file, to the last bit; without a unit, since the surface has none.

    Raises
    ------
    ValueError
        If rhino3dm finds the surface invalid.
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
    if not surface.IsValid:
        raise ValueError("surface must be valid in .3dm files, but rhino3dm finds it is not; write .json.")
    model = rhino3dm.File3dm()
    model.Settings.ModelUnitSystem = getattr(rhino3dm.UnitSystem, "None")
    attributes = rhino3dm.ObjectAttributes()
    attributes.Name = name
    model.Objects.AddSurface(surface, attributes)
    return base64.b64decode(model.Encode())
