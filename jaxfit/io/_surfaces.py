"""Surfaces in files: NumPy's .npz, and geomdl's exchange JSON."""

import io
import json
import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit._checks import check_kind
from jaxfit._fit import Fit
from jaxfit._splines import BSplineSurface
from jaxfit.io._arrays import load_arrays
from jaxfit.io._output import check_output, write_atomically
from jaxfit.io._point_data import InputError
from jaxfit.io._points import check_input

_KEYS = ("control_points", "knots_u", "knots_v")
# What a parser raises on damaged files, and what a surface that is none raises.
_DAMAGED = (ValueError, TypeError, LookupError, AttributeError, RecursionError)


def write_surface(path: str | os.PathLike, surface: BSplineSurface | Fit) -> None:
    """Write a surface, or that of a fit; the file appears whole or not at all, and replaces an older one.

    - ``.npz``: arrays ``control_points`` (nu, nv, d), ``knots_u``, ``knots_v`` and ``order``
      (2,), in the surface's own precision.
    - ``.json``: geomdl's exchange format (``geomdl.exchange.import_json``). geomdl scales knots
      to [0, 1] when it reads them.

    Parameters
    ----------
    path
        The file; its suffix chooses the format.
    surface
        The surface, or a `jaxfit.Fit`.

    Raises
    ------
    InputError
        If the path cannot be written (see `check_output`).
    TypeError
        If `surface` is neither a surface nor a fit.
    ValueError
        If the surface has control points that are not finite.
    OSError
        If writing fails half-way, for instance because the disk is full.
    """
    check_output(path)
    surface = surface.surface if isinstance(surface, Fit) else surface
    check_kind("surface", surface, BSplineSurface, "fit.surface")
    control_points = np.asarray(surface.control_points)
    if not np.isfinite(control_points).all():
        raise ValueError(
            "surface must have finite control points, but some are NaN or infinite; do not "
            "write a fit that failed."
        )
    knots_u, knots_v = np.asarray(surface.knots_u), np.asarray(surface.knots_v)
    if Path(path).suffix.lower() == ".json":
        shape = _geomdl(control_points, knots_u, knots_v)
        content = json.dumps(shape, separators=(",", ":")).encode()
    else:
        buffer = io.BytesIO()
        np.savez(
            buffer,
            control_points=control_points,
            knots_u=knots_u,
            knots_v=knots_v,
            order=np.asarray(surface.order),
        )
        content = buffer.getvalue()
    write_atomically(path, content)


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


def _geomdl(control_points: np.ndarray, knots_u: np.ndarray, knots_v: np.ndarray) -> dict[str, Any]:
    nu, nv, d = control_points.shape
    surface = {
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
    return {"shape": {"type": "surface", "count": 1, "data": [surface]}}


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
