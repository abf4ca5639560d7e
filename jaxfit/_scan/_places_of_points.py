"""Places of points that are no nodes: linear around the nearest node."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit._scan._manifold import Faces
from jaxfit._scan._node_normals import node_normals

CANDIDATES = 8  # nodes next to a point
ACROSS = 4.0  # by how much a step across the sheet counts more
REACH = 2.0  # longest step from a node, as a multiple of the usual edge


def carried_places(
    points: Float[Any, "points 3"],
    nodes: Float[Any, "nodes 3"],
    faces: Faces,
    flat: Float[Any, "nodes 2"],
    known: Int[Any, " points"] | None = None,
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, " points"]]:
    """Places in the plane of all points, and their distances from the nearest nodes, which may be `known`: -1
    where they are not.

    A step out of the tangent plane counts more: where sheets face each other closely, the nearest node may be
    on the wrong one.
    """
    from scipy.spatial import cKDTree

    away, near = cKDTree(nodes).query(points, min(CANDIDATES, len(nodes)))
    steps = points[:, None] - nodes[near]
    above = np.abs(np.sum(steps * node_normals(nodes, faces)[near], axis=2))
    best = np.argmin(away + ACROSS * above, axis=1)[:, None]
    nearest = np.take_along_axis(near, best, axis=1)[:, 0]
    nearest = nearest if known is None else np.where(known >= 0, known, nearest)
    away = np.linalg.norm(points - nodes[nearest], axis=1)
    step = np.einsum("pij,pj->pi", _gradients(nodes, faces, flat)[nearest], points - nodes[nearest])
    edge = np.median(np.linalg.norm(flat[faces[:, 0]] - flat[faces[:, 1]], axis=1))
    length, most = np.linalg.norm(step, axis=1, keepdims=True), REACH * edge
    step = step * np.where(length > most, most / np.maximum(length, most), 1.0)
    return flat[nearest] + np.where(away[:, None] > 0, step, 0.0), away


def _gradients(nodes: np.ndarray, faces: Faces, flat: np.ndarray) -> Float[np.ndarray, "nodes 2 3"]:
    """Of the map, the means over the triangles around each node, weighted by area."""
    edges = np.stack([nodes[faces[:, k]] - nodes[faces[:, 0]] for k in (1, 2)], axis=2)
    moves = np.stack([flat[faces[:, k]] - flat[faces[:, 0]] for k in (1, 2)], axis=2)
    area = np.linalg.norm(np.cross(edges[..., 0], edges[..., 1]), axis=1)
    gradient = moves @ np.linalg.pinv(edges, rcond=1e-3) * area[:, None, None]
    total, weight = np.zeros((len(nodes), 2, 3)), np.zeros(len(nodes))
    for k in range(3):
        np.add.at(total, faces[:, k], gradient)
        np.add.at(weight, faces[:, k], area)
    return total / np.maximum(weight, np.finfo(float).tiny)[:, None, None]
