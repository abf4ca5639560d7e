"""Surfaces in files: the lossless formats, and what other programs read."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._checks import check_kind
from jaxfit._fit import Fit
from jaxfit._splines import BSplineSurface
from jaxfit._trimmed import TrimmedSurface
from jaxfit._trimmed._trimmed_surface import host_loops
from jaxfit.io._cad import iges_bytes, step_bytes
from jaxfit.io._nets import clamped_net, near_origin
from jaxfit.io._output import check_output, write_atomically
from jaxfit.io._point_data import InputError, one_line
from jaxfit.io._points import check_input
from jaxfit.io._rhino import rhino_bytes
from jaxfit.io._stored import json_bytes, npz_bytes, stored_surface
from jaxfit.io._tessellation import mesh_bytes, tessellate

# What a parser raises on damaged files, and what a surface that is none raises.
_DAMAGED = (ValueError, TypeError, LookupError, AttributeError, RecursionError)


def write_surface(
    path: str | os.PathLike, surface: BSplineSurface | TrimmedSurface | Fit
) -> Float[np.ndarray, " d"]:
    """Write a surface, trimmed or not, or that of a fit; the file appears whole or not at all.

    - ``.npz``: arrays ``control_points`` (nu, nv, d), ``knots_u``, ``knots_v`` and ``order`` (2,), in the
      surface's own precision; of loops ``loop_vertices`` (k, 2), one after another, and ``loop_counts``, how
      many each has
    - ``.json``: geomdl's exchange format (``geomdl.exchange.import_json``); geomdl scales knots to [0, 1]
      when it reads them; loops are freeform trims, in the knots of the file
    - ``.step``, ``.stp``: one face of a B-spline surface, AP214 (OCP), whose edges are the loops
    - ``.iges``, ``.igs``: one trimmed surface (OCP), by default the whole surface
    - ``.3dm``: Rhino's format, exact, without a unit (rhino3dm); loops are curves beside the whole surface
    - ``.ply``, ``.stl``, ``.obj``: triangles within 0.01 % of the diagonal, ``.ply`` and ``.stl`` in single
      precision (trimesh)

    All but the first two need the extra ``cad`` and a surface in three dimensions. Coordinates are written
    as they are, whatever their unit; STEP and IGES must name one, and say millimetres.

    Parameters
    ----------
    path
        The file; its suffix chooses the format.
    surface
        The surface, or a `jaxfit.Fit`, of which `trimmed` is written if it has one.

    Returns
    -------
    offset : array (d,)
        What was subtracted from the coordinates; add it to those of the file. Zero for ``.npz``, ``.json``
        and ``.3dm``. In the other formats, which lose digits far from the origin, it is a round number for
        each coordinate whose middle is more than 100 diagonals from zero. The file names it: STEP in the
        description of the product, the others in a comment.

    Raises
    ------
    InputError
        If the path cannot be written, or a library is not installed (see `check_output`).
    TypeError
        If `surface` is neither a surface nor a trimmed one nor a fit.
    ValueError
        If the surface has control points that are not finite, or is none that the format can hold: not in
        three dimensions, with a jump, or too small for STEP and IGES (less than 1e-4 across).
    OSError
        If writing fails half-way, for instance because the disk is full.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> net = np.array([[[0.0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 1]]])
    >>> knots = np.array([0.0, 0, 1, 1])
    >>> surface = jf.BSplineSurface(net, knots, knots)
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "patch.json"
    >>> jf.io.write_surface(path, surface).tolist()
    [0.0, 0.0, 0.0]
    >>> jf.io.read_surface(path)(0.5, 0.5).tolist()
    [0.5, 0.5, 0.25]
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            f"path must be the name of a file, but is a {type(path).__name__}; pass the name first, then the "
            "surface."
        )
    check_output(path)
    if isinstance(surface, Fit):
        surface = surface.surface if surface.trimmed is None else surface.trimmed
    trimmed = surface if isinstance(surface, TrimmedSurface) else None
    whole: Any = surface if trimmed is None else trimmed.surface
    check_kind("surface", whole, BSplineSurface, "fit.surface")
    if not np.isfinite(np.asarray(whole.control_points)).all():
        raise ValueError(
            "surface must have finite control points, but some are NaN or infinite; do not "
            "write a fit that failed."
        )
    content, offset = _content(Path(path), whole, trimmed)
    write_atomically(path, content)
    return offset


def _content(path: Path, surface: BSplineSurface, trimmed: TrimmedSurface | None) -> tuple[bytes, np.ndarray]:
    """The bytes of the file, and the offset that was subtracted."""
    suffix, nowhere = path.suffix.lower(), np.zeros(surface.dimension)
    if suffix == ".npz":
        return npz_bytes(surface, trimmed), nowhere
    if suffix == ".json":
        return json_bytes(surface, trimmed), nowhere
    net = clamped_net(surface)
    loops = [] if trimmed is None else host_loops(trimmed)
    if suffix == ".3dm":
        return rhino_bytes(net, loops, path.stem), nowhere
    centred, offset = near_origin(net)
    note = "written by jaxfit"
    if offset.any():
        note += "; add to coordinates: " + " ".join(map(repr, offset.tolist()))
    if suffix in (".step", ".stp"):
        return step_bytes(centred, loops, path.stem, note), offset
    if suffix in (".iges", ".igs"):
        return iges_bytes(centred, loops, path.stem, note), offset
    if trimmed is None:
        return mesh_bytes(*tessellate(centred), suffix, note), offset
    vertices, triangles, *_ = trimmed.tessellate()
    return mesh_bytes(vertices - offset, triangles, suffix, note), offset


def read_surface(path: str | os.PathLike) -> BSplineSurface | TrimmedSurface:
    """Read a surface that `write_surface` or geomdl's ``export_json`` wrote.

    Parameters
    ----------
    path
        The file, ``.npz`` or ``.json``.

    Returns
    -------
    BSplineSurface or TrimmedSurface
        In JAX's default precision; trimmed if the file holds loops.

    Raises
    ------
    InputError
        If the file cannot be read, holds no surface or more than one, or a rational one.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path, knots = pathlib.Path(tempfile.mkdtemp()) / "flat.npz", np.array([0.0, 0, 1, 1])
    >>> _ = jf.io.write_surface(path, jf.BSplineSurface(np.zeros((2, 2, 3)), knots, knots))
    >>> jf.io.read_surface(path).shape
    (2, 2)
    """
    path = Path(path)
    check_input(path, (".npz", ".json"))
    try:
        return stored_surface(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(
            f"{path} holds no B-spline surface that can be read ({one_line(error)}); write it "
            "with jaxfit.io.write_surface."
        ) from error
