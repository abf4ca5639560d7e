"""The mesh of a cloud: by neighbours in space, from given faces, or over the principal plane."""

from typing import NamedTuple

import numpy as np

from jaxfit._progress_line import doing
from jaxfit._scan._coarse_mesh import coarse_faces
from jaxfit._scan._denoised_nodes import denoised_nodes, is_noisy
from jaxfit._scan._even_choice import even_choice
from jaxfit._scan._flat_places import flat_places
from jaxfit._scan._gap_closing import with_gaps_closed
from jaxfit._scan._level_sheet import is_level, level_mesh, level_nodes, principal_frame
from jaxfit._scan._manifold import Faces, areas, in_use, longest_edges, pieces, single_fans
from jaxfit._scan._neighbourhood_mesh import neighbourhood_mesh
from jaxfit._scan._node_normals import area_without_noise
from jaxfit._scan._places_of_points import carried_places
from jaxfit._scan._scan_lines import thinned_along_lines
from jaxfit._scan._topology import TornMeshError, largest_piece, sheet_loops

MOST_NODES = 30_000  # of the mesh; of more points, medians over squares or an even choice
COMMON_SPACING = 99  # per cent of the points have their sixth neighbour nearer,
LEVEL_NODES = 10_000  # of a mesh over a plane: hardly more than control points, or it is rougher than any fit
HOLE_SPACINGS = 2.0  # and so many of those distances make a hole
GAP = 0.25  # of the hole length: farther pieces of the mesh are off the sheet,
FLOCK = 10  # and so are those of at least so many nodes; fewer are what the mesh has left open
COVERED = 0.75  # least share of the nodes on the largest piece


class SheetMesh(NamedTuple):
    """Nodes, triangles, and places in the plane of the points."""

    nodes: np.ndarray
    faces: Faces
    loops: list[np.ndarray]
    flat: np.ndarray  # (nodes, 2)
    places: np.ndarray  # (points, 2)
    away: np.ndarray  # (points,) distance to the nearest node of the sheet
    area: float


def sheet_mesh(cloud: np.ndarray, faces: Faces | None, length: float | None) -> tuple[SheetMesh, float]:
    """The mesh of the cloud, and the length that decided what is a hole."""
    chosen = np.arange(len(cloud)) if len(cloud) <= MOST_NODES else even_choice(cloud, MOST_NODES)
    nodes = cloud[chosen]
    if faces is not None:
        return _from_faces(cloud, nodes, faces, chosen, length)
    every, nodes = len(nodes), thinned_along_lines(nodes)
    try:
        return _by_neighbours(cloud, nodes, length, on_lines=len(nodes) < every)
    except TornMeshError as error:
        if is_level(cloud):
            return _level(cloud, length)
        return _without_noise(cloud, nodes, length, error)


def _by_neighbours(
    cloud: np.ndarray,
    nodes: np.ndarray,
    length: float | None,
    noise: bool = True,
    on_lines: bool = False,
) -> tuple[SheetMesh, float]:
    """The mesh of nodes that neighbours agree on."""
    reach = _hole_length(nodes) if length is None else length
    found = neighbourhood_mesh(nodes, reach, on_lines=on_lines)
    if _coverage(nodes, found) < COVERED:
        found = neighbourhood_mesh(nodes, reach, least_votes=1)
    if len(found) > COVERED * 2 * len(nodes):
        largest_piece(nodes, found)  # says so if there are several
    if (covered := _coverage(nodes, found)) < COVERED:
        raise TornMeshError(
            f"points must lie on one sheet, but neighbours agree on a surface for only "
            f"{covered:.0%} of them; give a boundary, smooth the points, or raise "
            "hole_length where they are sparse."
        )
    whole = with_gaps_closed(nodes, largest_piece(nodes, found), reach)
    return _laid_out(cloud, nodes, whole, found, reach, noise=noise), reach


def _without_noise(
    cloud: np.ndarray, nodes: np.ndarray, length: float | None, error: TornMeshError
) -> tuple[SheetMesh, float]:
    """The mesh of fewer nodes, each where many points say; raises `error` where it was not noise."""
    for level in denoised_nodes(nodes) if is_noisy(nodes) else ():
        try:
            return _by_neighbours(cloud, level, length, noise=False)
        except TornMeshError:
            continue
    raise error


def _from_faces(
    cloud: np.ndarray, nodes: np.ndarray, faces: Faces, chosen: np.ndarray, length: float | None
) -> tuple[SheetMesh, float]:
    """The mesh of given faces, with nodes chosen where there are too many points."""
    if length is not None:
        faces = single_fans(faces[longest_edges(cloud, faces) <= length])  # or pieces may touch at a point
    closed, region = length, None
    if len(nodes) < len(cloud):
        faces, region = coarse_faces(cloud, faces, chosen)
        closed = max(length or 0.0, HOLE_SPACINGS * float(np.median(longest_edges(nodes, faces))))
    whole = largest_piece(nodes, faces)
    whole = whole if closed is None else with_gaps_closed(nodes, whole, closed)
    reach = length or float(longest_edges(nodes, whole).max())
    return _laid_out(cloud, nodes, whole, faces, reach, region), reach


def _coverage(nodes: np.ndarray, faces: Faces) -> float:
    """Triangles of the largest piece, over the number of a mesh with all nodes."""
    return float(np.bincount(pieces(faces)).max()) / (2 * len(nodes)) if len(faces) else 0.0


def _laid_out(
    cloud: np.ndarray,
    nodes: np.ndarray,
    faces: Faces,
    before: Faces,
    length: float,
    region: np.ndarray | None = None,
    noise: bool = True,
) -> SheetMesh:
    """The largest piece of a mesh of nodes in space; all points get places from the nearest node, or from the
    node of their `region`.

    Points of another piece of the mesh `before` are off the sheet, unless that piece is next to it.
    """
    used = in_use(faces, len(nodes))
    stray = _next_to(cloud, nodes, _separate(nodes, before, used, GAP * length), used)
    number = np.where(used, np.cumsum(used) - 1, -1)
    known = None if region is None else np.where(region >= 0, number[region], -1)
    nodes, faces = nodes[used], number[faces]
    loops = sheet_loops(nodes, faces)
    doing(f"laying {len(faces):,} triangles out flat")
    flat = flat_places(nodes, faces, loops)
    places, away = carried_places(cloud, nodes, faces, flat, known)
    area = area_without_noise(nodes, faces) if noise else float(areas(nodes, faces).sum())
    return SheetMesh(nodes, faces, loops, flat, places, np.where(stray, np.inf, away), area)


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


def _level(cloud: np.ndarray, length: float | None) -> tuple[SheetMesh, float]:
    """The sheet over the principal plane; lengths are measured in the plane."""
    from scipy.spatial import cKDTree

    frame = principal_frame(cloud)[0]
    turned = cloud @ frame.T
    nodes = level_nodes(turned, LEVEL_NODES)
    flat = nodes * [1, 1, 0]
    reach = _hole_length(flat) if length is None else length
    faces = largest_piece(flat, level_mesh(nodes, reach))
    used = in_use(faces, len(nodes))
    nodes, faces = nodes[used], (np.cumsum(used) - 1)[faces]
    away = cKDTree(nodes[:, :2]).query(turned[:, :2])[0]
    loops = sheet_loops(nodes * [1, 1, 0], faces)
    area = float(areas(nodes, faces).sum())  # medians have little noise
    return SheetMesh(nodes @ frame, faces, loops, nodes[:, :2], turned[:, :2], away, area), reach


def _hole_length(nodes: np.ndarray) -> float:
    return HOLE_SPACINGS * neighbour_distance(nodes, COMMON_SPACING)


def neighbour_distance(nodes: np.ndarray, share: int = 50) -> float:
    """From its sixth neighbour, so many per cent of the nodes are at most this far."""
    from scipy.spatial import cKDTree

    sixth = cKDTree(nodes).query(nodes, min(7, len(nodes)))[0][:, -1]
    return float(np.percentile(sixth, share))
