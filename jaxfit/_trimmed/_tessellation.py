"""Triangles of a trimmed surface."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit._splines import BSplineSurface
from jaxfit._trimmed._checked_loops import Loop
from jaxfit._trimmed._triangulation import triangulate

DEVIATION = 1e-4  # of triangles from the surface, as a fraction of the diagonal
_MOST_VERTICES = 500_000


class Tessellation(NamedTuple):
    """Triangles whose vertices are on a surface.

    Attributes
    ----------
    vertices : array (vertices, d)
    triangles : array (triangles, 3)
        Indices of vertices. The normals of the triangles are along R_u x R_v.
    u, v : array (vertices,)
        Parameters of the vertices: `surface(u, v)` gives them again, differentiably.
    """

    vertices: Float[np.ndarray, "vertices d"]
    triangles: Int[np.ndarray, "triangles 3"]
    u: Float[np.ndarray, " vertices"]
    v: Float[np.ndarray, " vertices"]


def tessellate(
    surface: BSplineSurface,
    loops: list[Loop],
    lines: tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]],
    deviation: float,
    most: int = _MOST_VERTICES,
) -> Tessellation:
    """The region inside `loops`, with `lines` the distinct knots along u and along v."""
    from scipy.interpolate import NdBSpline

    net, knots_u, knots_v = (
        np.asarray(x, np.float64) for x in (surface.control_points, surface.knots_u, surface.knots_v)
    )
    spline = NdBSpline((knots_u, knots_v), net, tuple(order - 1 for order in surface.order))
    # As many pieces as a polynomial has turns: the middle of an S is on its chord.
    pieces = max(1, max(surface.order) - 2)
    grid = [np.interp(np.arange(pieces * (len(x) - 1) + 1) / pieces, np.arange(len(x)), x) for x in lines]
    diagonal = float(np.linalg.norm(np.ptp(net, axis=(0, 1))))

    def points_at(places: np.ndarray) -> np.ndarray:
        return np.asarray(spline(np.ascontiguousarray(places)))

    places, triangles = triangulate(points_at, loops, (grid[0], grid[1]), deviation * diagonal, most)
    vertices = points_at(places)
    p, q, r = (vertices[triangles[:, i]] for i in range(3))
    # Triangles at a pole have no area.
    kept = triangles[((q - p).any(axis=1) & (r - p).any(axis=1) & (r - q).any(axis=1))]
    used, index = np.unique(kept, return_inverse=True)
    return Tessellation(vertices[used], index.reshape(kept.shape), *places[used].T)
