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


def mesh_bytes(vertices: Vertices, triangles: Triangles, suffix: str, note: str) -> bytes:
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

    Each span of the knots of u and of v is cut into pieces, more of them until the triangles are within
    `deviation` of the surface, as a fraction of the diagonal, halfway along their sides, or until there would
    be more than `most` vertices. Triangles without an area are left out.
    """
    breaks = [np.unique(knots) for knots in (net.knots_u, net.knots_v)]
    # At first as many pieces as a polynomial has turns: the middle of an S is on its chord.
    pieces = [np.full(len(at) - 1, max(1, max(net.order) - 2)) for at in breaks]
    while np.prod([2 * x.sum() + 1 for x in pieces]) <= most:
        finer = _points(net, breaks, [2 * x for x in pieces])
        too_few = _too_few(finer, pieces, deviation * net.diagonal)
        if not any(few.any() for few in too_few):
            break
        pieces = [np.where(few, 2 * x, x) for few, x in zip(too_few, pieces, strict=True)]
    points = _points(net, breaks, pieces)
    index = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    triangles = np.concatenate(
        [np.stack([corner.reshape(-1) for corner in corners], axis=1) for corners in ((a, b, d), (a, d, c))]
    )
    vertices = points.reshape(-1, 3)
    p, q, r = (vertices[triangles[:, i]] for i in range(3))
    return vertices, triangles[np.cross(q - p, r - p).any(axis=1)]


def _points(net: ClampedNet, breaks: list[Any], pieces: list[Any]) -> Float[np.ndarray, "a b 3"]:
    """Points at the breaks and at pieces - 1 places between two neighbours."""
    matrices = []
    for knots, order, at, counts in zip((net.knots_u, net.knots_v), net.order, breaks, pieces, strict=True):
        places = [k + np.arange(n) / n for k, n in enumerate(counts)] + [[len(counts)]]
        parameters = np.interp(np.concatenate(places), np.arange(len(at)), at)
        matrices.append(basis_matrix(knots, order, parameters))
    return along_both(matrices[0], net.control_points, matrices[1])


def _too_few(points: Float[np.ndarray, "a b 3"], pieces: list[Any], limit: float) -> list[Any]:
    """Which spans of u and of v need more pieces: triangles between every second point are farther than
    `limit` from the points halfway along their sides. Where only the diagonal is, both do.
    """
    coarse = points[::2, ::2]
    along_u = _distances(points[1::2, ::2], coarse[:-1], coarse[1:])
    along_v = _distances(points[::2, 1::2], coarse[:, :-1], coarse[:, 1:])
    across = _distances(points[1::2, 1::2], coarse[:-1, :-1], coarse[1:, 1:])
    starts = [np.concatenate([[0], np.cumsum(x)[:-1]]) for x in pieces]
    few_u = np.maximum.reduceat(along_u.max(axis=1), starts[0]) > limit
    few_v = np.maximum.reduceat(along_v.max(axis=0), starts[1]) > limit
    cells = np.maximum.reduceat(np.maximum.reduceat(across, starts[0], axis=0), starts[1], axis=1) > limit
    left = cells & ~few_u[:, None] & ~few_v
    return [few_u | left.any(axis=1), few_v | left.any(axis=0)]


def _distances(
    points: Float[np.ndarray, "a b 3"], start: Float[np.ndarray, "a b 3"], end: Float[np.ndarray, "a b 3"]
) -> Float[np.ndarray, "a b"]:
    """From line segments."""
    side, gap = end - start, points - start
    squared = np.maximum(np.sum(side * side, axis=2), np.finfo(float).tiny)
    along = np.clip(np.sum(side * gap, axis=2) / squared, 0.0, 1.0)
    return np.linalg.norm(gap - along[..., None] * side, axis=2)
