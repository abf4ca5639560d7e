"""Triangles of a surface, and files of them, by trimesh."""

import importlib
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit._base._host_splines import along_both, basis_matrix
from jaxfit.io._nets import ClampedNet

_DEVIATION = 1e-4  # of triangles from the surface, as a fraction of the diagonal
_MOST_POINTS = 2_000_000
_STL_HEADER = 80  # bytes

Vertices = Float[np.ndarray, "vertices 3"]
Triangles = Int[np.ndarray, "triangles 3"]


def mesh_file(vertices: Vertices, triangles: Triangles, suffix: str, note: str) -> bytes:
    """Triangles in a .ply, .stl or .obj file.

    Raises
    ------
    ValueError
        If the surface has no area.
    """
    trimesh: Any = importlib.import_module("trimesh")
    if not len(triangles):
        raise ValueError("surface must have an area to be written as triangles, but has none; write .json.")
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    comment = note.encode("ascii", "replace")
    if suffix == ".obj":
        diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
        digits = int(np.clip(np.ceil(10 - np.log10(diagonal)), 0, 300))  # after the decimal point
        text: str = mesh.export(file_type="obj", digits=digits, include_normals=False, header=note)
        return text.encode()
    content: bytes = mesh.export(file_type=suffix[1:])
    if suffix == ".stl":
        return comment[:_STL_HEADER].ljust(_STL_HEADER) + content[_STL_HEADER:]
    return content.replace(b"element vertex", b"comment " + comment + b"\nelement vertex", 1)


def tessellate(
    net: ClampedNet, deviation: float = _DEVIATION, most: int = _MOST_POINTS
) -> tuple[Vertices, Triangles]:
    """Vertices on a grid of parameters and triangles between them, whose normals are along R_u x R_v.

    Every span of the knots is cut into the same number of pieces, which is doubled until the triangles are
    within `deviation` of the surface, as a fraction of the diagonal, halfway along their sides, or until
    doubling would make more than `most` vertices. Triangles without an area are left out.
    """
    # At first as many pieces as a polynomial has turns: the middle of an S is on its chord.
    pieces = max(1, max(net.order) - 2)
    points = _points(net, pieces)
    while (2 * points.shape[0] - 1) * (2 * points.shape[1] - 1) <= most:
        finer = _points(net, 2 * pieces)
        if _deviation(finer) <= deviation * net.diagonal:
            break
        pieces, points = 2 * pieces, finer
    index = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    triangles = np.concatenate(
        [np.stack([corner.reshape(-1) for corner in corners], axis=1) for corners in ((a, b, d), (a, d, c))]
    )
    vertices = points.reshape(-1, 3)
    p, q, r = (vertices[triangles[:, i]] for i in range(3))
    return vertices, triangles[np.cross(q - p, r - p).any(axis=1)]


def _points(net: ClampedNet, pieces: int) -> Float[np.ndarray, "a b 3"]:
    """Points at the knots and at pieces - 1 places between two neighbours."""
    matrices = []
    for knots, order in zip((net.knots_u, net.knots_v), net.order, strict=True):
        breaks = np.unique(knots)
        at = np.interp(np.arange(pieces * (len(breaks) - 1) + 1) / pieces, np.arange(len(breaks)), breaks)
        matrices.append(basis_matrix(knots, order, at))
    return along_both(matrices[0], net.control_points, matrices[1])


def _deviation(points: Float[np.ndarray, "a b 3"]) -> float:
    """Distances of the points halfway along the sides of the triangles between every second point."""
    coarse = points[::2, ::2]
    sides = (
        (points[1::2, ::2], coarse[:-1], coarse[1:]),
        (points[::2, 1::2], coarse[:, :-1], coarse[:, 1:]),
        (points[1::2, 1::2], coarse[:-1, :-1], coarse[1:, 1:]),
    )
    return max(float(_distances(*side).max()) for side in sides)


def _distances(
    points: Float[np.ndarray, "a b 3"], start: Float[np.ndarray, "a b 3"], end: Float[np.ndarray, "a b 3"]
) -> Float[np.ndarray, "a b"]:
    """From line segments."""
    side, gap = end - start, points - start
    squared = np.maximum(np.sum(side * side, axis=2), np.finfo(float).tiny)
    along = np.clip(np.sum(side * gap, axis=2) / squared, 0.0, 1.0)
    return np.linalg.norm(gap - along[..., None] * side, axis=2)
