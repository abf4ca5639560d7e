"""From raw points to a sheet: which points are on it, their places when laid out flat, rim and holes."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._scan._cleaning import Cleaned, cleaned
from jaxfit._scan._extras import import_shapely
from jaxfit._scan._flat_places import Rectangle, flat_places, rectangle_around
from jaxfit._scan._hole_filling import filled_holes
from jaxfit._scan._level_sheet import is_level, level_mesh, level_nodes, principal_frame
from jaxfit._scan._manifold import Faces, areas, in_use, longest_edges, manifold, pieces
from jaxfit._scan._neighbourhood_mesh import neighbourhood_mesh
from jaxfit._scan._node_gradients import carried_places
from jaxfit._scan._topology import largest_piece, sheet_loops

LEAST_POINTS = 12
MOST_NODES = 30_000  # of the mesh; of more points, medians over squares or an even choice
COMMON_SPACING = 99  # per cent of the points have their sixth neighbour nearer,
HOLE_SPACINGS = 2.0  # and so many of those distances make a hole
OUTSET = 0.5  # of the spacing: how far beyond nodes that stand for several points the rim is
GAP = 0.25  # of the hole length: farther pieces of the mesh are off the sheet,
FLOCK = 10  # and so are those of at least so many nodes; fewer are what the mesh has left open
LEAST_MARGIN, LARGEST_MARGIN = 0.02, 0.1  # of the domain
COVERED = 0.75  # least share of the nodes on the largest piece


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
    centre: Float[np.ndarray, "3"]
    size: float
    spacing: float  # between nodes around it
    outset: float  # how far points may lie outside the loops of nodes
    hole_length: float  # in the unit of the points handed in
    counts: dict[str, int]

    def layout(self, net: tuple[int, int], order: tuple[int, int]) -> "Layout":
        """Parameters for a net, with a margin of one knot span around the sheet.

        The control points on the border then have no influence on the sheet, if the net is not too coarse.
        """
        spans = np.asarray(net) - np.asarray(order) + 1
        share = np.clip(1 / spans, LEAST_MARGIN, LARGEST_MARGIN)
        whole = self.sides / (1 - 2 * share)
        inside = np.clip(self.places / whole + share, share, 1 - share)
        return Layout(inside, whole)

    @property
    def area(self) -> float:
        """Of the mesh, in the squared unit of the points handed in."""
        return float(areas(self.nodes, self.faces).sum()) * self.size**2


class Layout(NamedTuple):
    """A sheet in the unit square."""

    parameters: Float[np.ndarray, "kept 2"]
    sides: Float[np.ndarray, "2"]  # lengths that the square stands for


class _Mesh(NamedTuple):
    """Nodes, triangles, and places in the plane of the points."""

    nodes: np.ndarray
    faces: Faces
    loops: list[np.ndarray]
    flat: np.ndarray  # (nodes, 2)
    places: np.ndarray  # (points, 2)
    away: np.ndarray  # (points,) distance to the nearest node of the sheet


def sheet_of(
    points: Float[Any, "points 3"], faces: Faces | None = None, hole_length: float | None = None
) -> Sheet:
    """Clean the points, connect them, and lay the sheet out in the unit square."""
    import_shapely()  # a missing extra is to be said first
    clean = cleaned(points)
    if len(clean.kept) < LEAST_POINTS:
        raise ValueError(
            f"points must hold at least {LEAST_POINTS} distinct and finite points without a boundary, but "
            f"hold {len(clean.kept)}; give more, or pass a boundary."
        )
    cloud = points[clean.kept]
    centre = cloud.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    cloud = (cloud - centre) / size
    asked = None if hole_length is None else hole_length / size
    mesh, length = _mesh(cloud, _given_faces(points, clean, faces), asked)
    rectangle: Rectangle = rectangle_around(mesh.flat)
    on_sheet = mesh.away <= length
    places = np.clip(mesh.places @ rectangle.axes.T - rectangle.corner, 0.0, rectangle.sides)
    counts = {
        "points_read": len(points),
        "non_finite": clean.non_finite,
        "duplicates": clean.duplicates,
        "outliers": clean.outliers,
        "off_the_sheet": int((~on_sheet).sum()),
    }
    nearest = _nearest((points[np.isfinite(points).all(axis=1)] - centre) / size, cloud)
    spacing = float(np.median(np.concatenate([_steps(mesh.nodes[x]) for x in mesh.loops])))
    outset = 0.0 if len(mesh.nodes) <= len(cloud) < MOST_NODES else OUTSET * spacing
    return Sheet(
        cloud, clean.kept, nearest, on_sheet, places, mesh.nodes, mesh.faces, mesh.loops, rectangle.sides,
        centre, size, spacing, outset, length * size, counts,
    )  # fmt: skip


def _nearest(points: np.ndarray, cloud: np.ndarray) -> Int[np.ndarray, " points"]:
    from scipy.spatial import cKDTree

    return cKDTree(cloud).query(points)[1]


def _steps(loop: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)


def _mesh(cloud: np.ndarray, faces: Faces | None, length: float | None) -> tuple[_Mesh, float]:
    """The mesh of the cloud, and the length that decided what is a hole."""
    if faces is not None:
        longest = longest_edges(cloud, faces)
        if length is not None:
            faces = faces[longest <= length]
        whole = largest_piece(cloud, faces)
        whole = whole if length is None else filled_holes(cloud, whole, length)
        reach = float(longest.max()) if length is None else length
        return _laid_out(cloud, cloud, whole, faces, reach), reach
    nodes = cloud if len(cloud) <= MOST_NODES else _even_choice(cloud)
    reach = _hole_length(nodes) if length is None else length
    found = neighbourhood_mesh(nodes, reach)
    if (covered := _coverage(nodes, found)) < COVERED:
        if is_level(cloud):
            return _level(cloud, length)
        found = neighbourhood_mesh(nodes, reach, least_votes=1)
        covered = _coverage(nodes, found)
    whole = filled_holes(nodes, largest_piece(nodes, found), reach)
    if covered < COVERED:
        raise ValueError(
            f"points must lie on one sheet, but neighbours agree on a surface for only "
            f"{covered:.0%} of them; give a boundary, smooth the points, or raise "
            "hole_length where they are sparse."
        )
    return _laid_out(cloud, nodes, whole, found, reach), reach


def _coverage(nodes: np.ndarray, faces: Faces) -> float:
    """Triangles of the largest piece, over the number of a mesh with all nodes."""
    return float(np.bincount(pieces(faces)).max()) / (2 * len(nodes)) if len(faces) else 0.0


def _laid_out(cloud: np.ndarray, nodes: np.ndarray, faces: Faces, before: Faces, length: float) -> _Mesh:
    """The largest piece of a mesh of nodes in space; all points get places from the nearest node.

    Points of another piece of the mesh `before` are off the sheet, unless that piece is next to it.
    """
    used = in_use(faces, len(nodes))
    stray = _next_to(cloud, nodes, _separate(nodes, before, used, GAP * length), used)
    nodes, faces = nodes[used], (np.cumsum(used) - 1)[faces]
    loops = sheet_loops(nodes, faces)
    flat = flat_places(nodes, faces, loops)
    places, away = carried_places(cloud, nodes, faces, flat)
    return _Mesh(nodes, faces, loops, flat, places, np.where(stray, np.inf, away))


def _separate(nodes: np.ndarray, faces: Faces, used: np.ndarray, gap: float) -> np.ndarray:
    """Nodes of other pieces that are farther away than the gap, or large."""
    from scipy.spatial import cKDTree

    tree, number, found = cKDTree(nodes[used]), pieces(faces), np.zeros(len(nodes), bool)
    for piece in range(1, int(number.max()) + 1):
        some = np.unique(faces[number == piece])
        away = len(some) >= FLOCK or tree.query(nodes[some])[0].min() > gap
        found[some] = away and not used[some].any()
    return found


def _next_to(cloud: np.ndarray, nodes: np.ndarray, some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which points are nearer to some nodes than to others."""
    from scipy.spatial import cKDTree

    if not some.any():
        return np.zeros(len(cloud), bool)
    return cKDTree(nodes[some]).query(cloud)[0] < cKDTree(nodes[others]).query(cloud)[0]


def _level(cloud: np.ndarray, length: float | None) -> tuple[_Mesh, float]:
    """The sheet over the principal plane; lengths are measured in the plane."""
    from scipy.spatial import cKDTree

    frame = principal_frame(cloud)[0]
    turned = cloud @ frame.T
    nodes = level_nodes(turned, MOST_NODES).nodes
    flat = nodes * [1, 1, 0]
    reach = _hole_length(flat) if length is None else length
    faces = largest_piece(flat, level_mesh(nodes, reach))
    used = in_use(faces, len(nodes))
    nodes, faces = nodes[used], (np.cumsum(used) - 1)[faces]
    away = cKDTree(nodes[:, :2]).query(turned[:, :2])[0]
    loops = sheet_loops(nodes * [1, 1, 0], faces)
    return _Mesh(nodes @ frame, faces, loops, nodes[:, :2], turned[:, :2], away), reach


def _hole_length(nodes: np.ndarray) -> float:
    from scipy.spatial import cKDTree

    count = min(7, len(nodes))
    sixth = cKDTree(nodes).query(nodes, count)[0][:, -1]
    return HOLE_SPACINGS * float(np.percentile(sixth, COMMON_SPACING))


def _even_choice(cloud: np.ndarray) -> np.ndarray:
    """About `MOST_NODES` of the points, one from each cube that has any."""
    size = 1.0 / np.sqrt(MOST_NODES)
    while True:
        cell = np.floor(cloud / size).astype(int)
        _, first = np.unique(cell, axis=0, return_index=True)
        if len(first) <= MOST_NODES:
            return cloud[np.sort(first)]
        size *= max(np.sqrt(len(first) / MOST_NODES), 1.02)


def _given_faces(points: np.ndarray, clean: Cleaned, faces: Faces | None) -> Faces | None:
    """The faces between the kept points; a duplicate is the point that it repeats."""
    if faces is None or len(clean.kept) > MOST_NODES:
        return None
    _, inverse = np.unique(points, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    place = np.full(inverse.max() + 1, -1)
    place[inverse[clean.kept]] = np.arange(len(clean.kept))
    numbers = place[inverse[faces]]
    whole = (numbers >= 0).all(axis=1) & (np.diff(np.sort(numbers, axis=1), axis=1) > 0).all(axis=1)
    found = manifold(numbers[whole])
    if len(found) < COVERED * len(faces):
        raise ValueError(
            f"faces must make a surface whose triangles run round the same way, but only {len(found)} of "
            f"{len(faces)} do; turn them alike, or leave faces out."
        )
    return found
