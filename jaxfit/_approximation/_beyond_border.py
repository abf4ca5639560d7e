"""Which points lie beyond the border of a surface, measured on the host."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxfit._base._host_splines import basis_matrix
from jaxfit._splines import BSplineSurface

FAR = 4.0  # times the average error of points whose feet are inside the border
BLOCK = 4096  # points whose dense basis functions are in memory


def points_beyond_border(
    surface: BSplineSurface,
    points: Any,
    feet: tuple[Any, Any],
    errors: Float[np.ndarray, " points"],
    counted: Bool[np.ndarray, " points"],
) -> Bool[np.ndarray, " points"]:
    """Those that count, are far from the surface, have their feet on its border, and lie along the tangent
    plane there rather than across it, as an outlier above the surface does.
    """
    at_ends = np.zeros(len(errors), bool)
    for x, ends in zip(feet, surface.domain, strict=True):
        for end in ends:
            at_ends |= np.asarray(x) == np.asarray(end)
    inside = counted & ~at_ends
    usual = errors[inside].mean() if inside.any() else 0.0
    beyond = counted & at_ends & (errors > FAR * usual)
    chosen = np.flatnonzero(beyond)
    for start in range(0, len(chosen), BLOCK):
        part = chosen[start : start + BLOCK]
        u, v = (np.asarray(x, float)[part] for x in feet)
        beyond[part] = _lie_along(surface, np.asarray(points)[part], u, v)
    return beyond


def _lie_along(
    surface: BSplineSurface, points: Float[Any, "points d"], u: np.ndarray, v: np.ndarray
) -> Bool[np.ndarray, " points"]:
    """Whether the vector from the foot is at most 45 degrees from the tangent plane."""
    net = np.asarray(surface.control_points, float)
    middle = net.reshape(-1, net.shape[2]).mean(axis=0)
    along_u, along_v = (
        [basis_matrix(np.asarray(t, float), k, x, derivative) for derivative in (0, 1)]
        for t, k, x in zip((surface.knots_u, surface.knots_v), surface.order, (u, v), strict=True)
    )
    foot, by_u, by_v = (
        np.einsum("pi,pj,ijd->pd", along_u[a], along_v[b], net - middle, optimize=True)
        for a, b in ((0, 0), (1, 0), (0, 1))
    )
    way = points.astype(float) - middle - foot
    first = _unit(by_u)
    second = _unit(by_v - np.sum(by_v * first, axis=1, keepdims=True) * first)
    along = sum(np.sum(way * x, axis=1) ** 2 for x in (first, second))
    return 2 * along >= np.sum(way**2, axis=1)


def _unit(vectors: Float[np.ndarray, "points d"]) -> Float[np.ndarray, "points d"]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
