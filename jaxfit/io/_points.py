"""`read_points`: one function for every file of points, chosen by suffix."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base import Boundary
from jaxfit._checks import said_missing
from jaxfit.io._arrays import load_arrays
from jaxfit.io._point_data import MOST_COLUMNS, InputError, PointData, grid_data
from jaxfit.io._scans import SCANS, read_scan
from jaxfit.io._text import read_columns

BOUNDARY_KEYS = ("boundary_v0", "boundary_v1", "boundary_u0", "boundary_u1")
_KEYS = ("grid", "points", *BOUNDARY_KEYS)
SUFFIXES = (".npz", ".npy", ".csv", ".xyz", ".txt", *SCANS)
_LEAST_POINTS = 4


def read_points(path: str | os.PathLike) -> PointData:
    """Read scattered points or a grid, and the border if the file holds one.

    - ``.npz``: ``grid`` (n, m, 3), or ``points`` (N, 3) with or without ``boundary_v0``, ``boundary_v1``,
      ``boundary_u0``, ``boundary_u1`` (see `jaxfit.Boundary`); other keys are ignored, and so are ``points``
      beside a ``grid``
    - ``.npy``: one array, (N, 3) scattered or (n, m, 3) grid
    - ``.csv``: scattered, one point a line, commas, semicolons or tabs; a first line may hold names, of more
      than three columns those of x, y and z (also ``X [mm]``, ``x_mm``, ...) wherever they stand
    - ``.xyz``, ``.txt``: the same with blanks instead of commas. Each kind may have the separators of the
      other, and begin with the number of points
    - ``.ply``, ``.stl``, ``.obj``, ``.off``: the vertices of a mesh; the points of a ``.ply``, ``.obj`` or
      ``.off`` without faces (trimesh)
    - ``.las``, ``.laz``: a survey, with the scale and offset of the file (laspy, lazrs)
    - ``.e57``: all scans, in the frame of the file (pye57)
    - ``.pcd``: fields x, y and z (pypcd4)

    Other columns, blank lines and lines that begin with ``#`` are ignored. Coordinates become float64;
    units and large offsets stay as they are.

    Those that name a library need the extra ``scan``. Some of them say of points that they are no
    measurements, by a flag or by NaN, and meshes may repeat a vertex (STL: in every triangle). Such points
    are left out and counted in `PointData.left_out`. In NumPy's and text files NaN is an error.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    PointData

    Raises
    ------
    InputError
        For a missing or unreadable file, an unknown suffix, a library that is not installed, arrays of
        the wrong shape, text that holds no numbers, more than three named columns without x, y and z, NaN or
        infinite coordinates in NumPy's and text files, fewer than four points, and a boundary that is
        incomplete or whose corners do not meet.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "four.xyz"
    >>> _ = path.write_text("0 0 0\\n1 0 0\\n0 1 0\\n1 1 0.5\\n")
    >>> data = jf.io.read_points(path)
    >>> data.points.shape, data.boundary, data.left_out
    ((4, 3), None, {})
    """
    path = Path(path)
    suffix = path.suffix.lower()
    check_input(path, SUFFIXES)
    if suffix in (".csv", ".xyz", ".txt"):
        return _from_array(read_columns(path), "points", path)
    if suffix in SCANS:
        points, left_out, faces = read_scan(path)
        return dataclasses.replace(_from_array(points, "points", path), left_out=left_out, faces=faces)
    arrays, names = load_arrays(path, _KEYS)
    if suffix == ".npy" and "array" in arrays:
        array = arrays["array"]
        return _from_array(array, "grid" if array.ndim == 3 else "points", path)
    if "grid" in arrays:
        return _from_array(arrays["grid"], "grid", path)
    if "points" in arrays:
        data = _from_array(arrays["points"], "points", path)
        return dataclasses.replace(data, boundary=_boundary(arrays, path))
    raise InputError(
        f"{path} holds neither a grid nor points, but {', '.join(names[:5]) or 'nothing'}; store "
        "an array 'grid' of shape (n, m, 3) or 'points' of shape (N, 3)."
    )


def read_boundary(path: str | os.PathLike) -> Boundary:
    """The four border polylines in the keys ``boundary_*`` of an .npz file.

    Parameters
    ----------
    path
        The file; `read_points` says what the keys hold.

    Returns
    -------
    Boundary

    Raises
    ------
    InputError
        If the file cannot be read, a polyline is missing, or their corners do not meet.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "square.npz"
    >>> sides = dict(boundary_v0=[[0.0, 0, 0], [1, 0, 0]], boundary_v1=[[0.0, 1, 0], [1, 1, 0]])
    >>> np.savez(path, **sides, boundary_u0=[[0.0, 0, 0], [0, 1, 0]], boundary_u1=[[1.0, 0, 0], [1, 1, 0]])
    >>> jf.io.read_boundary(path).v1.tolist()
    [[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]
    """
    path = Path(path)
    check_input(path, (".npz",))
    boundary = _boundary(load_arrays(path, BOUNDARY_KEYS)[0], path)
    if boundary is None:
        raise InputError(f"{path} holds no boundary; store {', '.join(BOUNDARY_KEYS)} in it.")
    return boundary


def check_input(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raise unless `path` is a file that is not empty and has one of these suffixes."""
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file in it ({path}/* names all to `jaxfit batch`).")
    if not path.exists():
        raise InputError(said_missing(path))
    if path.suffix.lower() not in suffixes:
        raise InputError(
            f"{path} has {'no suffix' if not path.suffix else f'the suffix {path.suffix}'}, "
            f"so its format is not known; use one of {', '.join(suffixes)}."
        )
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty; give a file with points.")


def _from_array(array: np.ndarray, key: str, path: Path) -> PointData:
    shape, ndim = ("(n, m, 3)", 3) if key == "grid" else ("(N, 3)", 2)
    if key == "points" and array.ndim == 2 and len(array) == 3 and array.shape[1] > _LEAST_POINTS:
        raise InputError(f"{path}: points has shape {array.shape}; it must be (N, 3): store the transpose.")
    if key == "points" and array.ndim == 2 and array.shape[1] > MOST_COLUMNS:
        raise InputError(
            f"{path}: points has shape {array.shape}; it must be (N, 3), or a grid (n, m, 3) if these are "
            "heights."
        )
    if key == "grid" and array.ndim == 3:
        _check_coordinates_last(array.shape, path)
    array = _coordinates(array, key, ndim, shape, path)
    if array.size < 3 * _LEAST_POINTS:
        raise InputError(
            f"{path} holds {array.size // 3} point{'s' * (array.size != 3)}, but a surface needs "
            f"at least {_LEAST_POINTS}; give more."
        )
    if key == "grid":
        return grid_data(array, path.name, path)
    return PointData(array, None, None, path.name)


def _check_coordinates_last(shape: tuple[int, ...], path: Path) -> None:
    """Raise for a grid with more than coordinates on its last axis, if another has three, or too many."""
    if shape[2] > 3 and 3 in shape[:2]:
        turned = f": store np.moveaxis(grid, {shape.index(3)}, -1)"
    elif shape[2] > MOST_COLUMNS:
        turned = ""
    else:
        return
    raise InputError(f"{path}: grid has shape {shape}; it must be (n, m, 3){turned}.")


def _coordinates(
    array: np.ndarray, key: str, ndim: int, shape: str, path: Path
) -> Float[np.ndarray, "... 3"]:
    """The first three columns as finite float64."""
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: {key} has dtype {array.dtype}; store the coordinates as real numbers.")
    if array.ndim != ndim or array.shape[-1] < 3:
        raise InputError(f"{path}: {key} has shape {array.shape}; it must be {shape}.")
    array = np.ascontiguousarray(array[..., :3], dtype=np.float64)
    good = np.isfinite(array).all(axis=-1)
    if not good.all():
        first = np.argwhere(~good)[0]
        raise InputError(
            f"{path}: {int((~good).sum())} of {good.size} points in array '{key}' have NaN or infinite "
            f"coordinates, the first at index {', '.join(str(int(i)) for i in first)}; "
            f"{'remove or repair them' if array.ndim == 2 else 'write the others as points (N, 3)'}."
        )
    return array


def _boundary(arrays: Mapping[str, np.ndarray], path: Path) -> Boundary | None:
    missing = [key for key in BOUNDARY_KEYS if key not in arrays]
    if len(missing) == len(BOUNDARY_KEYS):
        return None
    if missing:
        raise InputError(
            f"{path} holds an incomplete boundary without {', '.join(missing)}; store all four "
            "polylines or none."
        )
    sides: dict[str, Any] = {
        key.removeprefix("boundary_"): _coordinates(arrays[key], key, 2, "(n, 3)", path)
        for key in BOUNDARY_KEYS
    }
    try:
        return Boundary(**sides)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
