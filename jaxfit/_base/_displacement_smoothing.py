"""Smoothing of the displacements of a grid, weighted by their confidence."""

from typing import Any

import numpy as np
from jaxtyping import Float


def smoothed_displacements(
    moves: Float[Any, "a b d"], sure: Float[Any, "a b"], stiffness: float
) -> Float[Any, "a b d"]:
    r"""The displacements D, zero on the border, that minimise

    $$\sum_{ij} c_{ij} |D_{ij} - T_{ij}|^2
      + \mu \sum |\Delta_i^2 D|^2 + |\Delta_j^2 D|^2 ,$$

    T the moves, c (0 to 1) how sure each is, and second differences along both directions. Displacements
    rather than positions: where the confidence is 0 the grid keeps its shape.
    """
    from scipy.sparse import diags_array, eye_array, kron
    from scipy.sparse.linalg import splu

    rows, columns, d = moves.shape
    inside = np.zeros((rows, columns), bool)
    inside[1:-1, 1:-1] = True
    free = np.flatnonzero(inside)
    first, second = (_second_differences(n) for n in (rows, columns))
    plate = kron(first.T @ first, eye_array(columns)) + kron(eye_array(rows), second.T @ second)
    system = (stiffness * plate + diags_array(sure.ravel())).tocsr()[free][:, free]
    right = (sure[..., None] * moves).reshape(-1, d)[free]
    found = np.zeros((rows * columns, d))
    if len(free):
        found[free] = splu(system.tocsc()).solve(right)
    return found.reshape(rows, columns, d)


def _second_differences(count: int) -> Any:
    from scipy.sparse import diags_array

    size = max(count - 2, 0)
    parts = [np.full(size, x) for x in (1.0, -2.0, 1.0)]
    return diags_array(parts, offsets=[0, 1, 2], shape=(size, count))
