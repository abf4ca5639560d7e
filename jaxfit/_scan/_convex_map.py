"""A first map of a mesh to the plane without flipped triangles: mean-value weights, the rim on a circle."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit._scan._manifold import Faces
from jaxfit._symmetric_solve import solved_on_diagonal

LEAST_WEIGHT = 1e-3  # of the mean weight of an edge


def circle_map(
    points: Float[Any, "points 3"], faces: Faces, rim: Int[Any, " rim"]
) -> Float[np.ndarray, "points 2"]:
    """Places in the plane, each the weighted mean of its neighbours', the rim by chord length on a circle.

    With positive weights and a strictly convex rim no triangle flips, as long as the mesh is a disc: holes
    must have been closed.

    Source: M. S. Floater, Mean value coordinates, Computer Aided Geometric Design 20 (2003).
    """
    from scipy.sparse import diags_array

    places = np.zeros((len(points), 2))
    places[rim] = _on_circle(points[rim])
    inner = np.ones(len(points), bool)
    inner[rim] = False
    weights = _mean_value_weights(points, faces)[inner]
    system = diags_array(np.asarray(weights.sum(axis=1)).ravel()) - weights[:, inner]
    places[inner] = solved_on_diagonal(system, weights[:, ~inner] @ places[~inner])
    return places


def _on_circle(rim: Float[Any, "rim 3"]) -> Float[np.ndarray, "rim 2"]:
    steps = np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1)
    steps = np.maximum(steps, 1e-3 * steps.mean())
    angle = 2 * np.pi * np.concatenate([[0.0], np.cumsum(steps)[:-1]]) / steps.sum()
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _mean_value_weights(points: np.ndarray, faces: Faces) -> Any:
    """Sparse: (tan(alpha / 2) + tan(beta / 2)) / r in the row of the vertex with these angles."""
    from scipy.sparse import csr_array

    rows, columns, values = [], [], []
    for k in range(3):
        at, one, other = (faces[:, (k + j) % 3] for j in range(3))
        first, second = points[one] - points[at], points[other] - points[at]
        far, away = (np.linalg.norm(x, axis=1) for x in (first, second))
        cosine = np.sum(first * second, axis=1) / (far * away)
        half = np.sqrt(np.maximum(1 - cosine, 0.0) / np.maximum(1 + cosine, 1e-6))  # tan(angle / 2)
        rows += [at, at]
        columns += [one, other]
        values += [half / far, half / away]
    weight = np.concatenate(values)
    weight = np.maximum(weight, LEAST_WEIGHT * weight.mean())
    shape = (len(points), len(points))
    return csr_array((weight, (np.concatenate(rows), np.concatenate(columns))), shape=shape)
