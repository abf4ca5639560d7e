r"""Maps of a mesh to the plane with little distortion and no flipped triangle, its rim free.

Minimises the symmetric Dirichlet energy $\sum_f A_f (|J_f|^2 + |J_f^{-1}|^2)$ over the places of the
vertices, by the reweighted local/global iteration of Rabinovich, Poranne, Panozzo and Sorkine-Hornung
(Scalable locally injective mappings, ACM Trans. Graph. 36, 2017). The energy is
infinite where a triangle would flip.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit._scan._manifold import Faces
from jaxfit._symmetric_solve import solved_on_diagonal

MOST_STEPS = 50
ENOUGH = 2e-4  # a step that lowers the energy by less than this share is the last,
ISOMETRY = 4.0  # the energy of a map without distortion; unless what is above it
LARGE = 0.1  # falls by at least this share
NEGLIGIBLE = 1e-4  # and is more than this, as where a sheet can be rolled out flat
LEAST_HEIGHT = 0.05  # of a triangle over its longest edge; flatter ones count as if they were so high
NEAR_FLIP = 0.8  # of the step at which the first triangle would flip
SHORTEST = 1e-4  # step
PROXIMITY = 1e-6  # of the mean diagonal entry: holds the map where it may be moved freely
ISOMETRIC = 1e-4  # |s - 1| for which the quotient of the weights is taken at its limit


class Triangles(NamedTuple):
    """Of each triangle: its vertices, the gradients of its barycentric coordinates, its weight."""

    faces: Faces
    gradients: Float[np.ndarray, "faces 2 3"]
    weights: Float[np.ndarray, " faces"]

    def jacobians(self, places: Float[Any, "points 2"]) -> Float[np.ndarray, "faces 2 2"]:
        """Of the map from the triangle's own plane to the common one."""
        return np.swapaxes(places[self.faces], 1, 2) @ np.swapaxes(self.gradients, 1, 2)


def rest_triangles(points: Float[Any, "points 3"], faces: Faces, shares: Float[Any, " faces"]) -> Triangles:
    """The triangles in planes of their own; `shares` are by how much their areas count."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    base = np.linalg.norm(b - a, axis=1)
    along = np.sum((c - a) * (b - a), axis=1) / base
    height = np.linalg.norm(c - a - (along / base)[:, None] * (b - a), axis=1)
    longest = np.maximum(base, np.maximum(np.linalg.norm(c - a, axis=1), np.linalg.norm(c - b, axis=1)))
    height = np.maximum(height, LEAST_HEIGHT * longest)
    zero = np.zeros(len(faces))
    edges = np.stack([np.stack([base, along], axis=1), np.stack([zero, height], axis=1)], axis=1)
    inverse = np.linalg.inv(edges)  # rows: gradients of the second and third coordinate
    gradients = np.stack([-inverse.sum(axis=1), inverse[:, 0], inverse[:, 1]], axis=2)
    return Triangles(faces, gradients, shares * base * height / 2)


def energy(triangles: Triangles, places: Float[Any, "points 2"]) -> float:
    """The mean over the weights, 4 for an isometry; infinite if a triangle is flipped."""
    jacobian = triangles.jacobians(places)
    area = np.linalg.det(jacobian)
    if not (area > 0).all():
        return np.inf
    square = np.sum(jacobian**2, axis=(1, 2))
    return float(triangles.weights @ (square * (1 + 1 / area**2)) / triangles.weights.sum())


def isometric_maps(
    triangles: Triangles, places: Float[Any, "points 2"]
) -> Iterator[Float[np.ndarray, "points 2"]]:
    """From `places` without flips, map after map with less distortion and without flips."""
    scale = triangles.weights @ np.linalg.det(triangles.jacobians(places)) / triangles.weights.sum()
    places = places / np.sqrt(scale)
    now = energy(triangles, places)
    for _ in range(MOST_STEPS):
        direction = _global_step(triangles, places) - places
        step = min(1.0, NEAR_FLIP * _first_flip(triangles, places, direction))
        while (after := energy(triangles, places + step * direction)) >= now and step > SHORTEST:
            step /= 2
        if not after < now:
            return
        places, before, now = places + step * direction, now, after
        yield places
        excess, fallen = now - ISOMETRY, before - now
        if fallen < ENOUGH * now and (excess < NEGLIGIBLE or fallen < LARGE * excess):
            return


def _global_step(triangles: Triangles, places: np.ndarray) -> np.ndarray:
    """The places that minimise the quadratic proxy sum A |W (J - R)|^2, R the nearest rotations."""
    from scipy.sparse import block_array, csr_array, eye_array

    left, size, right = np.linalg.svd(triangles.jacobians(places))
    rotation = left @ right
    near = np.abs(size - 1) < ISOMETRIC
    ratio = np.where(near, 4.0, (size - size**-3) / np.where(near, 1.0, size - 1))
    metric = (left * ratio[:, None, :]) @ np.swapaxes(left, 1, 2) * triangles.weights[:, None, None]
    gradients, faces, count = triangles.gradients, triangles.faces, len(places)
    stiffness = np.swapaxes(gradients, 1, 2) @ gradients
    rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, (1, 3)).ravel()

    def block(a: int, b: int) -> Any:
        values = (metric[:, a, b, None, None] * stiffness).ravel()
        return csr_array((values, (rows, columns)), shape=(count, count))

    mixed = block(0, 1)
    system = block_array([[block(0, 0), mixed], [mixed, block(1, 1)]])
    hold = PROXIMITY * float(system.diagonal().mean())
    pull = metric @ rotation @ gradients  # (faces, 2, 3)
    load = np.stack([np.bincount(faces.ravel(), pull[:, a].ravel(), count) for a in (0, 1)])
    matrix = system + hold * eye_array(2 * count)
    return solved_on_diagonal(matrix, load.ravel() + hold * places.T.ravel()).reshape(2, count).T


def _first_flip(triangles: Triangles, places: np.ndarray, direction: np.ndarray) -> float:
    """The least positive step at which a triangle has no area."""
    here, move = triangles.jacobians(places), triangles.jacobians(direction)
    c, a = np.linalg.det(here), np.linalg.det(move)
    b = np.linalg.det(here + move) - a - c
    root = np.sqrt(np.maximum(b * b - 4 * a * c, 0.0))
    q = -(b + np.where(b >= 0, root, -root)) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.stack([q / a, c / q])
    real = (b * b >= 4 * a * c) & np.isfinite(both) & (both > 0)
    return float(both[real].min()) if real.any() else np.inf
