"""Knots of a sheet laid out flat: closer together where its normal turns faster."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._scan._manifold import Faces
from jaxfit._scan._node_normals import node_normals

BINS = 64  # along each side
SMOOTHED = 1.5  # bins: standard deviation of the mean that is taken over neighbours
EVEN = 0.5  # share of the knots that is spread evenly
MARGIN = 0.5  # spans beyond the sheet at each end


def knot_densities(
    nodes: Float[Any, "nodes 3"], faces: Faces, flat: Float[Any, "nodes 2"], sides: Float[Any, "2"]
) -> Float[np.ndarray, "2 bins"]:
    """Of knots along both sides, by bins, with mean 1.

    Half of them go with the turn of the normal along the side, per length, its mean over the triangles of a
    bin. A sharp bend gets more than its share that way, and noise, which is everywhere, changes little.
    """
    from scipy.ndimage import gaussian_filter1d

    normals = node_normals(nodes, faces)
    corners, turns = flat[faces], normals[faces]
    edges, change = (np.stack([x[:, k] - x[:, 0] for k in (1, 2)], axis=2) for x in (corners, turns))
    area = np.abs(np.linalg.det(edges))
    some = area > np.finfo(float).eps * area.max()
    rate = np.linalg.norm(change[some] @ np.linalg.inv(edges[some]), axis=1)
    middle = corners[some].mean(axis=1)
    densities = []
    for axis in (0, 1):
        place = np.clip((middle[:, axis] / sides[axis] * BINS).astype(int), 0, BINS - 1)
        weight = np.bincount(place, area[some], BINS)
        total = np.bincount(place, area[some] * rate[:, axis], BINS)
        smooth, even = (gaussian_filter1d(x, SMOOTHED) for x in (total, weight))
        density = smooth / np.maximum(even, np.finfo(float).tiny)
        mean = density.mean()
        densities.append(EVEN + (1 - EVEN) * density / mean if mean > 0 else np.ones(BINS))
    return np.stack(densities)


def break_points(density: Float[Any, " bins"], side: float, spans: int) -> Float[np.ndarray, " breaks"]:
    """Ends of the spans, with a margin beyond 0 and `side`."""
    margin = min(MARGIN, spans / 4)
    inner = spans - 2 * margin
    rises = np.concatenate([[0.0], np.cumsum(density)]) * inner / density.sum()
    ends = np.linspace(0.0, side, len(rises))
    beyond = margin * side / len(density) / np.diff(rises)[[0, -1]]
    rises = np.concatenate([[-margin], rises, [inner + margin]])
    ends = np.concatenate([[-beyond[0]], ends, [side + beyond[1]]])
    return np.interp(np.arange(spans + 1) - margin, rises, ends)
