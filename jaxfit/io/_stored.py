"""The two lossless formats: NumPy's .npz and geomdl's exchange JSON."""

import io
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit._splines import BSplineSurface
from jaxfit._trimmed import TrimmedSurface
from jaxfit.io._arrays import load_arrays
from jaxfit.io._point_data import InputError

_KEYS = ("control_points", "knots_u", "knots_v")
_LOOP_KEYS = ("loop_vertices", "loop_counts")


def npz_bytes(surface: BSplineSurface, trimmed: TrimmedSurface | None) -> bytes:
    """Arrays of the surface and its loops, in their own precision."""
    arrays = {key: np.asarray(getattr(surface, key)) for key in _KEYS}
    arrays["order"] = np.asarray(surface.order)
    if trimmed is not None:
        arrays["loop_vertices"] = np.concatenate([np.asarray(loop) for loop in trimmed.loops])
        arrays["loop_counts"] = np.array([len(loop) for loop in trimmed.loops])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def json_bytes(surface: BSplineSurface, trimmed: TrimmedSurface | None) -> bytes:
    """The document that `geomdl.exchange.import_json` reads."""
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
    if trimmed is not None:
        document["trims"] = {"count": len(trimmed.loops), "data": _trims(trimmed)}
    shape = {"shape": {"type": "surface", "count": 1, "data": [document]}}
    return json.dumps(shape, separators=(",", ":")).encode()


def stored_surface(path: Path) -> BSplineSurface | TrimmedSurface:
    """The surface in a file, trimmed if it holds loops; raises whatever damaged files make it raise."""
    if path.suffix.lower() == ".json":
        arrays, loops = _from_geomdl(json.loads(path.read_text(encoding="utf-8")), path)
    else:
        found = load_arrays(path, (*_KEYS, *_LOOP_KEYS))[0]
        arrays, loops = [found[key] for key in _KEYS], []
        if _LOOP_KEYS[0] in found:
            vertices, counts = (found[key] for key in _LOOP_KEYS)
            if counts.sum() != len(vertices) or (counts < 0).any():
                raise ValueError(f"loop_counts adds up to {counts.sum()}, not to {len(vertices)} vertices")
            loops = np.split(vertices, np.cumsum(counts)[:-1])
    surface = BSplineSurface(*(jnp.asarray(x, jnp.result_type(float)) for x in arrays))
    return TrimmedSurface(surface, loops) if loops else surface


def _trims(trimmed: TrimmedSurface) -> list[dict[str, Any]]:
    """Closed polylines; what is inside a loop with a "reversed" of 1 is kept, with 0 it is cut away."""
    return [
        {
            "type": "freeform",
            "dimension": 2,
            "points": np.asarray(loop).tolist() + np.asarray(loop[:1]).tolist(),
            "name": "hole" if i else "outer loop",
            "reversed": 0 if i else 1,
        }
        for i, loop in enumerate(trimmed.loops)
    ]


def _from_geomdl(document: dict[str, Any], path: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
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
    return [control_points, *knots], [
        _loop(trim, path) for trim in surface.get("trims", {"data": []})["data"]
    ]


def _loop(trim: dict[str, Any], path: Path) -> np.ndarray:
    if trim["type"] != "freeform":
        raise InputError(f"{path} is trimmed by a {trim['type']}; only polylines (freeform) can be read.")
    points = np.asarray(trim["points"], dtype=float)
    return points[:-1] if (points[0] == points[-1]).all() else points
