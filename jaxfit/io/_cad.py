"""STEP and IGES through Open CASCADE: no other file knows of it."""

import contextlib
import io
import textwrap
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxfit.io._nets import ClampedNet

_TOLERANCE = 1e-7  # of a modelling kernel, absolute
_LEAST_DIAGONAL = 1e-4  # a thousand tolerances


def step_file(net: ClampedNet, name: str, note: str) -> bytes:
    """The surface as one face in a STEP file (AP214, millimetres).

    Raises
    ------
    ValueError
        If it makes no valid face.
    OSError
        If the file cannot be made.
    """
    from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
    from OCP.IFSelect import IFSelect_ReturnStatus
    from OCP.StepBasic import StepBasic_Product
    from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer
    from OCP.TCollection import TCollection_HAsciiString

    title, remark = (TCollection_HAsciiString(_ascii(text)) for text in (name, note))
    buffer = io.BytesIO()
    with _quiet():
        writer = STEPControl_Writer()
        status = writer.Transfer(_face(net), STEPControl_StepModelType.STEPControl_AsIs)
        if status == IFSelect_ReturnStatus.IFSelect_RetDone:
            model = writer.Model()
            for i in range(1, model.NbEntities() + 1):
                entity = model.Value(i)
                if isinstance(entity, StepBasic_Product):
                    entity.SetId(title)
                    entity.SetName(title)
                    entity.SetDescription(remark)
            header = APIHeaderSection_MakeHeader(model)
            header.SetName(title)
            header.SetDescriptionValue(1, remark)
            header.SetOriginatingSystem(TCollection_HAsciiString("jaxfit"))
            header.Apply(model)
            status = writer.WriteStream(buffer)
    if status != IFSelect_ReturnStatus.IFSelect_RetDone:
        raise OSError(f"the STEP file of {name} could not be made; write .3dm or .json.")
    return buffer.getvalue()


def iges_file(net: ClampedNet, name: str, note: str) -> bytes:
    """The surface as one trimmed surface (entity 144) in an IGES file (millimetres).

    Raises as `step_file`.
    """
    from OCP.IGESControl import IGESControl_Writer
    from OCP.IGESData import IGESData_IGESWriter
    from OCP.IGESSelect import IGESSelect_WorkLibrary

    buffer = io.BytesIO()
    with _quiet():
        writer = IGESControl_Writer("MM", 0)
        made = writer.AddShape(_face(net))
        writer.ComputeModel()
        model = writer.Model()
        for line in textwrap.wrap(_ascii(f"{name}: {note}"), 72):
            model.AddStartLine(line)
        lines = IGESData_IGESWriter(model)
        lines.FloatWriter().SetFormat("%.16E")  # all digits; the writer's own format has nine
        lines.SendModel(IGESSelect_WorkLibrary.DefineProtocol_s())
        made = lines.Print(buffer) and made
    if not made:
        raise OSError(f"the IGES file of {name} could not be made; write .3dm or .json.")
    return buffer.getvalue()


def _face(net: ClampedNet) -> Any:
    """The whole surface as a face, bounded by its four sides."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.BRepCheck import BRepCheck_Analyzer

    if not net.diagonal >= _LEAST_DIAGONAL:
        raise ValueError(
            f"surface must be at least {_LEAST_DIAGONAL:g} across for STEP and IGES, whose readers take "
            f"points closer than {_TOLERANCE:g} for one, but is {net.diagonal:.3g}; use a smaller unit."
        )
    maker = BRepBuilderAPI_MakeFace(_geometry(net), _TOLERANCE)
    if not (maker.IsDone() and BRepCheck_Analyzer(maker.Face()).IsValid()):
        raise ValueError(
            "surface must make a valid face, but Open CASCADE finds that it does not; write .3dm or .json."
        )
    return maker.Face()


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


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Open CASCADE prints nothing meanwhile."""
    from OCP.Message import Message

    messenger = Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:
        messenger.RemovePrinter(printer)
    try:
        yield
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()
