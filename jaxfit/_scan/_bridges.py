"""Triangles across a narrow gap, which tie two edges of a sheet together."""

import numpy as np
from jaxtyping import Float

from jaxfit._scan._manifold import Faces, euler, longest_edges, pieces, single_fans

OPPOSED = -0.5  # cosine between the normals of two corners that face away from each other
MOST_BRIDGES = 50  # more are not bridges but noise
TIED = 0.98  # of the triangles stay on the largest piece where what is taken out was a bridge


def without_bridges(
    points: Float[np.ndarray, "points 3"], normals: Float[np.ndarray, "points 3"], faces: Faces
) -> Faces:
    """The triangles but for strips, between corners that face away from each other, without which the sheet
    hangs together as before and has fewer holes or handles: those between the two skins of a wing, at its
    open trailing edge, and not those round its sharp leading edge. The longest are looked at first.
    """
    corners = normals[faces]
    opposed = (np.sum(corners * np.roll(corners, 1, axis=1), axis=2) < OPPOSED).any(axis=1)
    if not opposed.any():
        return faces
    strip = np.full(len(faces), -1)
    strip[opposed] = pieces(faces[opposed])
    length = longest_edges(points, faces)
    longest = [float(np.median(length[strip == k])) for k in range(int(strip.max()) + 1)]
    if len(longest) > MOST_BRIDGES:
        return faces
    size, simple = _largest(faces), euler(faces)
    for k in np.argsort(longest)[::-1]:
        cut = single_fans(faces[strip != k])
        if len(cut) and _largest(cut) > TIED * size and euler(cut) > simple:
            faces, strip = faces[strip != k], strip[strip != k]
            size, simple = _largest(cut), euler(cut)
    return single_fans(faces)


def _largest(faces: Faces) -> int:
    return int(np.bincount(pieces(faces)).max())
