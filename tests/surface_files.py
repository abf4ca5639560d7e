"""Surfaces to write, and what other programs' readers say of the files."""

import numpy as np
import pytest
from helpers import clamped_uniform, random_surface, wavy_net, wavy_surface
from scipy.interpolate import BSpline

import jaxfit as jf

FAR = np.array([500_000.0, 5_200_000.0, 0.0])  # a place on earth, in metres


def need(*modules):
    for module in modules:
        pytest.importorskip(module, reason=f"{module} is not installed; pip install .[cad]")


def on_uniform_knots(net, order=(4, 4)):
    return jf.BSplineSurface(net, *(clamped_uniform(n, k) for n, k in zip(net.shape, order, strict=False)))


def tube(pole=False):
    """Closed along u: its first and last sides are one; with a pole, one more side is a point."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 12), np.linspace(0, 2, 6), indexing="ij")
    net = np.stack([np.cos(angle), np.sin(angle), height], axis=-1)
    net[-1] = net[0]
    if pole:
        net[:, 0] = [0.0, 0.0, -1.0]
    return on_uniform_knots(net)


def unclamped():
    return jf.BSplineSurface(wavy_net(7, 6), np.arange(11.0), np.arange(10.0))


def creased():
    """Knots as deep as the degree, along both directions. Its normal vanishes nowhere: where one does, Open
    CASCADE's quadrature of the area is too coarse to judge by."""
    net = wavy_net(10, 9) + 0.03 * np.random.default_rng(0).normal(size=(10, 9, 3))
    knots_u = [0, 0, 0, 0, 0.3, 0.3, 0.3, 0.6, 0.6, 0.8, 1, 1, 1, 1]
    knots_v = [0, 0, 0, 0.2, 0.4, 0.4, 0.7, 0.7, 0.8, 1, 1, 1]
    return jf.BSplineSurface(net, np.array(knots_u, float), np.array(knots_v, float))


def moved(surface, scale=1.0, offset=0.0):
    return jf.BSplineSurface(
        scale * np.asarray(surface.control_points) + offset, surface.knots_u, surface.knots_v
    )


SURFACES = {
    "wavy": wavy_surface,
    "creases": creased,
    "order 8": lambda: random_surface((8, 8), repeats=0, seed=4),
    "bilinear": lambda: on_uniform_knots(wavy_net(2, 2), (2, 2)),
    "tube": tube,
    "cone": lambda: tube(pole=True),
    "unclamped": unclamped,
    "small": lambda: moved(wavy_surface(), 1e-3),
    "large": lambda: moved(wavy_surface(), 1e5),
}


def samples(surface, count=15):
    return [np.linspace(float(low), float(high), count) for low, high in surface.domain]


def on_grid(surface, us, vs, du=0, dv=0):
    """Points or derivatives, by SciPy: nothing compiles."""
    net = np.asarray(surface.control_points, float)
    for knots, order, at, derivative in zip(
        (surface.knots_u, surface.knots_v), surface.order, (us, vs), (du, dv), strict=True
    ):
        net = np.swapaxes(BSpline(np.asarray(knots, float), net, order - 1)(at, derivative), 0, 1)
    return net


def area(surface, per_span=12):
    """By Gauss's quadrature on every rectangle of knots."""
    node, weight = np.polynomial.legendre.leggauss(per_span)
    at, weights = [], []
    for knots, (low, high) in zip((surface.knots_u, surface.knots_v), surface.domain, strict=True):
        breaks = np.unique(np.clip(np.asarray(knots), float(low), float(high)))
        half = 0.5 * np.diff(breaks)[:, None]
        at.append((breaks[:-1, None] + half * (1 + node)).reshape(-1))
        weights.append((half * weight).reshape(-1))
    normal = np.cross(on_grid(surface, *at, 1, 0), on_grid(surface, *at, 0, 1))
    return float(weights[0] @ np.linalg.norm(normal, axis=2) @ weights[1])


# ------------------------------------------------------ Open CASCADE's readers


def shape_in(path):
    """The shape in a STEP or IGES file, by Open CASCADE's reader."""
    from OCP.IGESControl import IGESControl_Reader
    from OCP.STEPControl import STEPControl_Reader

    reader = STEPControl_Reader() if path.suffix in (".step", ".stp") else IGESControl_Reader()
    reader.ReadFile(str(path))
    reader.TransferRoots()
    return reader.OneShape()


def only_face(shape):
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS

    explorer = TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_FACE)
    face = TopoDS.Face_s(explorer.Current()) if hasattr(TopoDS, "Face_s") else TopoDS.Face(explorer.Current())
    explorer.Next()
    assert not explorer.More()
    return face


def points_of(face, us, vs):
    from OCP.BRep import BRep_Tool

    surface = BRep_Tool.Surface_s(face)
    at = [[surface.Value(u, v) for v in vs.tolist()] for u in us.tolist()]
    return np.array([[(p.X(), p.Y(), p.Z()) for p in row] for row in at])


def area_of(shape):
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    properties = GProp_GProps()
    BRepGProp.SurfaceProperties_s(shape, properties, 1e-7)
    return properties.Mass()
