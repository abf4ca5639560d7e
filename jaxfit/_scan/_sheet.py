"""From raw points to a sheet: which points are on it, their places when laid out flat, rim and holes."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._progress_line import doing
from jaxfit._scan._cleaning import Cleaned, cleaned
from jaxfit._scan._extras import import_shapely
from jaxfit._scan._flat_places import Rectangle, rectangle_around
from jaxfit._scan._knot_density import break_points, knot_densities
from jaxfit._scan._level_sheet import principal_frame
from jaxfit._scan._manifold import Faces, manifold
from jaxfit._scan._sheet_mesh import COVERED, neighbour_distance, sheet_mesh

LEAST_POINTS = 12
LINE = 1e-6  # of the spread along it: points that spread less across it lie on a line


class Sheet(NamedTuple):
    """A sheet of points, in the unit and about the centre of the cloud."""

    points: Float[np.ndarray, "kept 3"]  # distinct, finite and not far off, centred, of size one
    number: Int[np.ndarray, " kept"]  # of each among the points handed in
    nearest: Int[np.ndarray, " finite"]  # of the points handed in that are finite: which of these is nearest
    on_sheet: Bool[np.ndarray, " kept"]
    places: Float[np.ndarray, "kept 2"]  # in the plane, from 0 to `sides`
    nodes: Float[np.ndarray, "nodes 3"]  # of the mesh
    faces: Faces
    loops: list[Int[np.ndarray, " _"]]  # nodes around the sheet, the rim first, the sheet to the left
    sides: Float[np.ndarray, "2"]  # of the smallest rectangle around the sheet laid out flat
    densities: Float[np.ndarray, "2 bins"]  # of knots along these
    centre: Float[np.ndarray, "3"]
    size: float
    spacing: float  # between nodes around it
    hole_length: float  # in the unit of the points handed in
    area: float  # of the mesh, in the squared unit of the points handed in
    counts: dict[str, int]

    def layout(self, net: tuple[int, int], order: tuple[int, int]) -> "Layout":
        """Parameters and knots for a net, with a margin of half a knot span around the sheet."""
        breaks = [
            break_points(density, float(side), n - k + 1)
            for density, side, n, k in zip(self.densities, self.sides, net, order, strict=True)
        ]
        low, whole = np.array([x[0] for x in breaks]), np.array([x[-1] - x[0] for x in breaks])
        u, v = ((x - x[0]) / (x[-1] - x[0]) for x in breaks)
        knots = np.pad(u, order[0] - 1, mode="edge"), np.pad(v, order[1] - 1, mode="edge")
        return Layout((self.places - low) / whole, whole, knots)


class Layout(NamedTuple):
    """A sheet in the unit square."""

    parameters: Float[np.ndarray, "kept 2"]
    sides: Float[np.ndarray, "2"]  # lengths that the square stands for
    knots: tuple[Float[np.ndarray, " knots_u"], Float[np.ndarray, " knots_v"]]  # clamped


def sheet_of(
    points: Float[Any, "points 3"],
    faces: Faces | None = None,
    hole_length: float | None = None,
    counted: Bool[np.ndarray, " points"] | None = None,
) -> Sheet:
    """Clean the points, connect them, and lay the sheet out in the unit square; points that are not `counted`
    have no say.
    """
    import_shapely()  # a missing extra is to be said first
    doing("cleaning the points")
    finite = np.isfinite(points).all(axis=1)
    clean = cleaned(points if counted is None else np.where(counted[:, None], points, np.nan))
    if len(clean.kept) < LEAST_POINTS:
        raise ValueError(
            f"points must hold at least {LEAST_POINTS} distinct and finite points without a boundary, but "
            f"hold {len(clean.kept)}; give more, or pass a boundary."
        )
    cloud = points[clean.kept]
    centre = cloud.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    cloud = (cloud - centre) / size
    _check_no_line(cloud)
    asked = None if hole_length is None else hole_length / size
    doing("connecting neighbours to a mesh")
    given = _given_faces(points, clean, faces)
    try:
        mesh, length = sheet_mesh(cloud, given, asked)
    except ValueError as error:
        if asked is None or asked >= (apart := neighbour_distance(cloud)):
            raise
        raise ValueError(
            f"hole_length is {hole_length:g}, but neighbours are some {apart * size:.3g} apart; raise it."
        ) from error
    rectangle: Rectangle = rectangle_around(mesh.flat)
    on_sheet = mesh.away <= length
    places = np.clip(mesh.places @ rectangle.axes.T - rectangle.corner, 0.0, rectangle.sides)
    counts = {
        "points_read": len(points),
        "non_finite": int((~finite).sum()),
        "duplicates": clean.duplicates,
        "outliers": clean.outliers,
        "off_the_sheet": int((~on_sheet).sum()),
    }
    flat = mesh.flat @ rectangle.axes.T - rectangle.corner
    densities = knot_densities(mesh.nodes, mesh.faces, flat, rectangle.sides)
    nearest = _nearest((points[finite] - centre) / size, cloud)
    spacing = float(np.median(np.concatenate([_steps(mesh.nodes[x]) for x in mesh.loops])))
    return Sheet(
        points=cloud,
        number=clean.kept,
        nearest=nearest,
        on_sheet=on_sheet,
        places=places,
        nodes=mesh.nodes,
        faces=mesh.faces,
        loops=mesh.loops,
        sides=rectangle.sides,
        densities=densities,
        centre=centre,
        size=size,
        spacing=spacing,
        hole_length=length * size,
        area=mesh.area * size**2,
        counts=counts,
    )


def _check_no_line(cloud: np.ndarray) -> None:
    spread = principal_frame(cloud)[1]
    if spread[1] < LINE * spread[0]:
        raise ValueError("points must make a surface, but lie on a line; give points on both sides of it.")


def _nearest(points: np.ndarray, cloud: np.ndarray) -> Int[np.ndarray, " points"]:
    from scipy.spatial import cKDTree

    return cKDTree(cloud).query(points)[1]


def _steps(loop: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)


def _given_faces(points: np.ndarray, clean: Cleaned, faces: Faces | None) -> Faces | None:
    """The faces between the kept points; a duplicate is the point that it repeats."""
    if faces is None:
        return None
    _, inverse = np.unique(points, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    place = np.full(inverse.max() + 1, -1)
    place[inverse[clean.kept]] = np.arange(len(clean.kept))
    numbers = place[inverse[faces]]
    whole = (numbers >= 0).all(axis=1) & (np.diff(np.sort(numbers, axis=1), axis=1) > 0).all(axis=1)
    found = manifold(numbers[whole])
    if len(found) < COVERED * whole.sum():
        raise ValueError(
            f"faces must make a surface whose triangles run round the same way, but only {len(found)} of "
            f"{whole.sum()} do; turn them alike, or leave faces out."
        )
    return found
