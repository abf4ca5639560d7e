"""Surfaces in files: NumPy's .npz, geomdl's exchange JSON, and what other programs read."""

import io
import json
import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfit._checks import check_kind
from jaxfit._fit import Fit
from jaxfit._splines import BSplineSurface
from jaxfit.io._arrays import load_arrays
from jaxfit.io._cad import iges_file, step_file
from jaxfit.io._nets import clamped_net, near_origin
from jaxfit.io._output import check_output, write_atomically
from jaxfit.io._point_data import InputError
from jaxfit.io._points import check_input
from jaxfit.io._rhino import rhino_file
from jaxfit.io._tessellation import mesh_file

_KEYS = ("control_points", "knots_u", "knots_v")
# What a parser raises on damaged files, and what a surface that is none raises.
_DAMAGED = (ValueError, TypeError, LookupError, AttributeError, RecursionError)


def write_surface(path: str | os.PathLike, surface: BSplineSurface | Fit) -> Float[np.ndarray, " d"]:
    """Write a surface, or that of a fit; the file appears whole or not at all, and replaces an older one.

    ==================  ===========================================================
    suffix              content
    ==================  ===========================================================
    ``.npz``            arrays ``control_points`` (nu, nv, d), ``knots_u``,
                        ``knots_v`` and ``order`` (2,), in the surface's own
                        precision
    ``.json``           geomdl's exchange format (``geomdl.exchange.import_json``);
                        geomdl scales knots to [0, 1] when it reads them
    ``.step``, ``.stp`` one face of a B-spline surface, AP214 (OCP)
    ``.iges``, ``.igs`` one trimmed surface, which is the whole surface (OCP)
    ``.3dm``            Rhino's format, exact, without a unit (rhino3dm)
    ``.ply``, ``.stl``  triangles within 0.01 % of the diagonal, ``.ply`` and
    ``.obj``            ``.stl`` in single precision (trimesh)
    ==================  ===========================================================

    All but the first two need the extra ``cad`` and a surface in three dimensions. Coordinates are written
    as they are, whatever their unit; STEP and IGES must name one, and say millimetres.

    Parameters
    ----------
    path
        The file; its suffix chooses the format.
    surface
        The surface, or a `jaxfit.Fit`.

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
        If `surface` is neither a surface nor a fit.
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
    check_output(path)
    surface = surface.surface if isinstance(surface, Fit) else surface
    check_kind("surface", surface, BSplineSurface, "fit.surface")
    if not np.isfinite(np.asarray(surface.control_points)).all():
        raise ValueError(
            "surface must have finite control points, but some are NaN or infinite; do not "
            "write a fit that failed."
        )
    content, offset = _content(Path(path), surface)
    write_atomically(path, content)
    return offset


def _content(path: Path, surface: BSplineSurface) -> tuple[bytes, np.ndarray]:
    """The bytes of the file, and the offset that was subtracted."""
    suffix, nowhere = path.suffix.lower(), np.zeros(surface.dimension)
    if suffix == ".npz":
        return _npz(surface), nowhere
    if suffix == ".json":
        return json.dumps(_geomdl(surface), separators=(",", ":")).encode(), nowhere
    net = clamped_net(surface)
    if suffix == ".3dm":
        return rhino_file(net, path.stem), nowhere
    net, offset = near_origin(net)
    note = "written by jaxfit"
    if offset.any():
        note += "; add to coordinates: " + " ".join(map(repr, offset.tolist()))
    if suffix in (".step", ".stp"):
        return step_file(net, path.stem, note), offset
    if suffix in (".iges", ".igs"):
        return iges_file(net, path.stem, note), offset
    return mesh_file(net, suffix, note), offset


def read_surface(path: str | os.PathLike) -> BSplineSurface:
    """Read a surface that `write_surface` or geomdl's ``export_json`` wrote.

    Returns
    -------
    BSplineSurface
        In JAX's default precision.

    Raises
    ------
    InputError
        If the file cannot be read, holds no surface or more than one, or a rational one.
    """
    path = Path(path)
    check_input(path, (".npz", ".json"))
    try:
        if path.suffix.lower() == ".json":
            arrays = _from_geomdl(json.loads(path.read_text(encoding="utf-8")), path)
        else:
            found = load_arrays(path, _KEYS)[0]
            arrays = [found[key] for key in _KEYS]
        return BSplineSurface(*(jnp.asarray(x, jnp.result_type(float)) for x in arrays))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(
            f"{path} holds no B-spline surface that can be read ({_one_line(error)}); write it "
            "with jaxfit.io.write_surface."
        ) from error


def _npz(surface: BSplineSurface) -> bytes:
    buffer = io.BytesIO()
    arrays = {key: np.asarray(getattr(surface, key)) for key in _KEYS}
    np.savez(buffer, **arrays, order=np.asarray(surface.order))  # type: ignore[arg-type]
    return buffer.getvalue()


def _geomdl(surface: BSplineSurface) -> dict[str, Any]:
    control_points, knots_u, knots_v = (np.asarray(getattr(surface, key)) for key in _KEYS)
    nu, nv, d = control_points.shape
    document = {
        "type": "spline",
        "rational": False,
        "dimension": d,
        "degree_u": len(knots_u) - nu - 1,
        "degree_v": len(knots_v) - nv - 1,
        "knotvector_u": knots_u.tolist(),
        "knotvector_v": knots_v.tolist(),
        "size_u": nu,
        "size_v": nv,
        # geomdl lets v run fastest, as C order does.
        "control_points": {"points": control_points.reshape(-1, d).tolist()},
        "delta": [0.05, 0.05],
    }
    return {"shape": {"type": "surface", "count": 1, "data": [document]}}


def _from_geomdl(document: dict[str, Any], path: Path) -> list[np.ndarray]:
    shape = document["shape"]
    if shape["type"] != "surface" or len(shape["data"]) != 1:
        raise InputError(
            f"{path} holds {len(shape['data'])} x {shape['type']}; keep exactly one surface in it."
        )
    surface = shape["data"][0]
    weights = np.asarray(surface["control_points"].get("weights", 1.0))
    if np.ptp(weights):
        raise InputError(f"{path} holds a rational surface; only surfaces with equal weights can be read.")
    points = np.asarray(surface["control_points"]["points"], dtype=float)
    control_points = points.reshape(surface["size_u"], surface["size_v"], -1)
    knots = [np.asarray(surface[f"knotvector_{which}"], dtype=float) for which in "uv"]
    return [control_points, *knots]


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
