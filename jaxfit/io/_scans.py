"""Points of scanners' files and of meshes, by the libraries of the extra `scan`.

What a file itself marks as no measurement is left out and counted.
"""

import warnings
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.io._extras import import_extra
from jaxfit.io._point_data import InputError, one_line

Counts = dict[str, int]
Points = Float[np.ndarray, "points 3"]
Faces = Int[np.ndarray, "faces 3"]
Found = tuple[Points, Counts, Faces | None]

_NOISE = (7, 18)  # LAS classes: low and high noise


def read_scan(path: Path) -> tuple[Points, Counts, Faces | None]:
    """The points of a file, float64, in file order, how many were left out for which reason, and faces.

    Raises
    ------
    InputError
        If the library is missing, or the file is damaged or holds no points in three dimensions.
    """
    suffix = path.suffix.lower()
    modules, read = _READERS[suffix]
    libraries = [import_extra(module, suffix, "scan") for module in modules]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            points, left_out, faces = read(path, libraries[0])
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or one_line(error)}.") from error
    except MemoryError as error:
        raise InputError(f"{path} holds more than there is memory for; thin the points.") from error
    except Exception as error:  # a parser may raise anything on a damaged file
        raise InputError(
            f"{path} is no {suffix} file that can be read, or was cut short ({one_line(error)}); "
            "write it again."
        ) from error
    return points, {reason: count for reason, count in left_out.items() if count}, faces


def _finite(points: Points) -> Bool[np.ndarray, " points"]:
    return np.isfinite(points).all(axis=1)


def _las(path: Path, laspy: Any) -> Found:
    las = laspy.read(path)
    points = _columns(las.x, las.y, las.z)  # scaled and shifted in float64
    _check_count(path, len(points), las.header.point_count)
    withheld = np.asarray(las.withheld, bool)
    noise = np.isin(np.asarray(las.classification), _NOISE) & ~withheld
    kept = ~withheld & ~noise
    finite = _finite(points)
    return (
        points[kept & finite],
        {
            "withheld": int(withheld.sum()),
            "classified as noise": int(noise.sum()),
            "not finite": int((kept & ~finite).sum()),
        },
        None,
    )


def _e57(path: Path, pye57: Any) -> Found:
    """All scans of a file, each in the frame of the file."""
    with pye57.E57(str(path)) as file:
        claimed, scans = 0, []
        for i in range(file.scan_count):
            claimed += file.get_header(i).point_count
            scan = file.read_scan(i, ignore_missing_fields=True)  # without points marked as invalid
            scans.append(_columns(*(scan[f"cartesian{axis}"] for axis in "XYZ")))
    points = np.concatenate([np.empty((0, 3)), *scans])
    finite = _finite(points)
    return points[finite], {"invalid": claimed - len(points), "not finite": int((~finite).sum())}, None


def _pcd(path: Path, pypcd4: Any) -> Found:
    cloud = pypcd4.PointCloud.from_path(path)
    missing = [axis for axis in "xyz" if axis not in cloud.fields]
    if missing:
        raise InputError(f"{path} holds no {' and no '.join(missing)}; write x, y and z for every point.")
    points = _columns(*(np.atleast_1d(cloud.pc_data[axis]) for axis in "xyz"))
    _check_count(path, len(points), cloud.metadata.points)
    finite = _finite(points)
    return points[finite], {"not finite": int((~finite).sum())}, None


def _mesh(path: Path, trimesh: Any) -> Found:
    """The vertices of a mesh, each once, and its faces; all points of a file without faces."""
    options = {"process": False, "maintain_order": True, "skip_materials": True}
    try:
        scene = trimesh.load_scene(str(path), **options)
    except ValueError:
        if path.suffix.lower() != ".ply":
            raise
        scene = trimesh.Scene(_mixed_ply(path, trimesh))
    pieces, corners, used = [np.empty((0, 3))], [np.empty((0, 3), int)], [np.empty(0, bool)]
    if path.suffix.lower() == ".off":
        _check_faces_of_off(path)
    for geometry in scene.geometry.values():
        _check_elements_of_ply(path, geometry.metadata.get("_ply_raw", {}))
        vertices = np.asarray(geometry.vertices, np.float64)
        faces = np.asarray(getattr(geometry, "faces", ()), int).reshape(-1, 3)
        referenced = np.full(len(vertices), not len(faces))
        referenced[faces.reshape(-1)] = True
        corners.append(faces + sum(map(len, pieces)))
        pieces.append(vertices)
        used.append(referenced)
    points, faces, in_face = (np.concatenate(x) for x in (pieces, corners, used))
    if not len(points):
        raise InputError(f"{path} holds no points, or was cut short; write it again.")
    finite = _finite(points)
    left_out = {"in no face": int((~in_face).sum()), "not finite": int((in_face & ~finite).sum())}
    kept = in_face & finite
    if not len(faces):
        return points[kept], left_out, None
    same = _first_of_equals(np.where(kept[:, None], points, np.nan))  # NaN equals nothing
    single = kept & (same == np.arange(len(points)))
    left_out["repeated"] = int(kept.sum() - single.sum())
    number = np.where(single, np.cumsum(single) - 1, -1)[same[faces]]
    whole = (number >= 0).all(axis=1) & (np.diff(np.sort(number, axis=1), axis=1) > 0).all(axis=1)
    return points[single], left_out, number[whole]


def _mixed_ply(path: Path, trimesh: Any) -> Any:
    """The mesh of a file whose faces have different numbers of corners, which trimesh takes for damaged."""
    data = import_extra("plyfile", ".ply", "scan").PlyData.read(str(path))
    vertices = _columns(*(data["vertex"][axis] for axis in "xyz"))
    names = ("vertex_indices", "vertex_index")
    faces = next(data["face"][name] for name in names if name in data["face"])
    fans = [[(face[0], *pair) for pair in pairwise(face[1:])] for face in faces]
    return trimesh.Trimesh(vertices, [x for fan in fans for x in fan], process=False)


def _first_of_equals(points: Points) -> Int[np.ndarray, " points"]:
    """The number of the first point that equals each, to the last bit."""
    order = np.lexsort(points.T)  # stable: among equals the first comes first
    ordered = points[order]
    new = np.ones(len(points), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    first = np.empty(len(points), int)
    first[order] = order[np.flatnonzero(new)[np.cumsum(new) - 1]]
    return first


def _columns(x: Any, y: Any, z: Any) -> Points:
    return np.stack([np.asarray(a, np.float64) for a in (x, y, z)], axis=1)


def _check_count(path: Path, count: int, claimed: int, what: str = "points") -> None:
    if count != claimed:
        raise InputError(f"{path} claims {claimed} {what}, but holds {count}; it was cut, so write it again.")


def _check_elements_of_ply(path: Path, elements: Any) -> None:
    """Raise where text was cut, of which trimesh takes the lines that are there."""
    for name, what in (("vertex", "points"), ("face", "faces")):
        element = elements.get(name, {})
        columns = element.get("data")
        if isinstance(columns, dict):  # binary data that was cut is refused by trimesh
            _check_count(path, min(map(len, columns.values())), element["length"], what)


def _check_faces_of_off(path: Path) -> None:
    """Raise where faces were cut off, for trimesh takes those that are there."""
    text = path.read_text(encoding="utf-8", errors="replace")
    bare = "\n".join(line.split("#")[0].strip() for line in text.splitlines())
    lines = [line for line in bare.split("OFF", 1)[1].splitlines() if line.strip()]
    vertices, faces = map(int, lines[0].split()[:2])
    _check_count(path, min(len(lines) - 1 - vertices, faces), faces, "faces")


_Reader = Callable[[Path, Any], Found]
_READERS: dict[str, tuple[tuple[str, ...], _Reader]] = {
    **dict.fromkeys((".ply", ".stl", ".obj", ".off"), (("trimesh",), _mesh)),
    **dict.fromkeys((".las", ".laz"), (("laspy", "lazrs"), _las)),
    ".e57": (("pye57",), _e57),
    ".pcd": (("pypcd4",), _pcd),
}
SCANS = tuple(_READERS)
