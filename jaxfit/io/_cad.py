"""STEP and IGES through Open CASCADE: only this file and `_cad_face` know of it."""

import contextlib
import io
import textwrap
from collections.abc import Iterator

from jaxfit._trimmed._checked_loops import Loop
from jaxfit.io._cad_face import face_of
from jaxfit.io._nets import ClampedNet


def step_bytes(net: ClampedNet, loops: list[Loop], name: str, note: str) -> bytes:
    """The surface, or its part inside the loops, as one face in a STEP file (AP214, millimetres).

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
        status = writer.Transfer(face_of(net, loops), STEPControl_StepModelType.STEPControl_AsIs)
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


def iges_bytes(net: ClampedNet, loops: list[Loop], name: str, note: str) -> bytes:
    """The same as one trimmed surface (entity 144) in an IGES file (millimetres).

    Raises as `step_bytes`.
    """
    from OCP.IGESControl import IGESControl_Writer
    from OCP.IGESData import IGESData_IGESWriter
    from OCP.IGESSelect import IGESSelect_WorkLibrary

    buffer = io.BytesIO()
    with _quiet():
        writer = IGESControl_Writer("MM", 0)
        made = writer.AddShape(face_of(net, loops))
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
