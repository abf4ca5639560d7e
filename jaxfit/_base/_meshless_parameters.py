"""Parameters of scattered points without a mesh, after Floater and Reimers (2001)."""

from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxfit._base._boundary import Boundary, checked_boundary
from jaxfit._base._delaunay_stars import Stars, mean_value_weights, stars
from jaxfit._base._douglas_peucker import chord_lengths, densify
from jaxfit._base._normalised_cloud import cloud_of
from jaxfit._base._parametric_stretch import area_stretch, link_weights
from jaxfit._checks import as_points, check_number, eager_where_concrete, is_concrete
from jaxfit._symmetric_solve import solved_on_diagonal

MOST_NODES = 2000  # added to a side whose vertices lie farther apart than the cloud's points
NODE_SPACING = 0.7  # nodes of a side are at least so far apart, times their distance from the cloud
# A point is a node of the boundary if it is this near, times the cloud's spacing: one of the two may have
# been rounded, as where they come from different files or the boundary is in single precision.
COINCIDENT = 1e-3
LEAST_COINCIDENT = 1e-9  # of the diagonal
LINK_ROUNDS = 6  # rounds in which links that stay long lose weight


class _Nodes(NamedTuple):
    """Boundary nodes first, then the free points."""

    points: np.ndarray  # (nodes, d)
    fixed: np.ndarray  # (fixed, 2) parameters of the boundary nodes
    free: np.ndarray  # (points,) whether a point of the cloud is a node of its own
    place: np.ndarray  # (points, 2) parameters of the others, on the boundary


@eager_where_concrete
def meshless_parameters(
    points: ArrayLike, boundary: Boundary, neighbours: int = 24, reweightings: int = 4
) -> tuple[Float[Any, " points"], Float[Any, " points"]]:
    r"""Parameters (u, v) in the unit square for points that no mesh connects.

    The sides of the boundary go to those of the square by chord length, corners to corners. Every other
    point is a convex combination of neighbours,

    $$(u_i, v_i) = \sum_j \lambda_{ij} (u_j, v_j), \qquad \lambda_{ij} > 0, \quad
      \textstyle\sum_j \lambda_{ij} = 1,$$

    one sparse linear system. The neighbours are the Delaunay star of the point in its tangent
    plane, with mean-value weights: a flat cloud with a boundary to scale keeps its shape however its
    density changes, where weights that fall with the distance alone draw dense regions together.
    Where the shape bulges, weights are then divided by the stretch around the neighbour (Yoshizawa, Belyaev
    and Seidel 2004), and the system solved again, as long as the total stretch falls.

    Parameters
    ----------
    points : array (points, d), d >= 2
        Any unit, any order. Those nearer to a vertex of the boundary than a thousandth of the median
        distance from a point to the nearest other one get its parameters.
    boundary : Boundary
        Four polylines. Nodes are added to sides whose edges are longer than the cloud's spacing.
    neighbours : int
        At least 6 (default 24): the number of nearest points among which the star is searched.
    reweightings : int
        Most reweightings by stretch (default 4); 0 for the linear system alone.

    Returns
    -------
    u, v : NumPy arrays (points,), float64, within [0, 1]

    Raises
    ------
    ValueError
        For too few neighbours, points that are not finite or not of the boundary's dimension.
    TypeError
        For traced arguments.

    Notes
    -----
    Duplicates count once. Points around a hole have neighbours across it as well, so that it keeps its
    size. Groups of points whose neighbours are all their own are tied to the nearest
    point outside. A point outside the boundary gets parameters inside the square, near those of its
    neighbours. Results do not depend on the order of points, nor, beyond rounding, on translation, rotation
    and scale.

    Sheets closer to each other than their points are among themselves grow together, and a closed tube has no
    parameters of this kind: open it, or use patches. One factorisation per reweighting, by SciPy on the host:
    0.5 s in all for 5,000 points, 10 s for 100,000 without reweighting.

    Sources: M. S. Floater, M. Reimers, Meshless parameterization and surface reconstruction, CAGD 18 (2001);
    S. Yoshizawa, A. Belyaev, H.-P. Seidel, A fast and simple stretch-minimizing mesh parameterization,
    Shape Modeling International (2004).

    Examples
    --------
    Points of a flat square keep their places:

    >>> x, y = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 7), indexing="ij")
    >>> grid = np.stack([x, y, 0 * x], axis=2)
    >>> u, v = jf.meshless_parameters(grid[1:-1, 1:-1].reshape(-1, 3), jf.Boundary.from_grid(grid))
    >>> bool(np.allclose(u, x[1:-1, 1:-1].ravel(), atol=1e-6))
    True
    """
    boundary = checked_boundary(boundary, points)
    check_number("neighbours", neighbours, 6, whole=True)
    check_number("reweightings", reweightings, 0, whole=True)
    if not is_concrete(points, boundary):
        raise TypeError(
            "points and boundary must be concrete, but are traced; call meshless_parameters outside jit."
        )
    given = np.asarray(as_points("points", points, boundary.v0.shape[1]))
    if given.shape[1] < 2:
        raise ValueError("points must have at least 2 coordinates, but have 1; use curve_parameters.")
    cloud = cloud_of(given, boundary)
    found = parameters_of(cloud.points, cloud.sides, neighbours, reweightings)[cloud.number]
    return found[:, 0], found[:, 1]


def parameters_of(
    points: Float[Any, "points d"], sides: list[np.ndarray], neighbours: int, reweightings: int
) -> Float[Any, "points 2"]:
    """The same for distinct points and sides of size one."""
    nodes = _nodes(points, sides)
    fixed = len(nodes.fixed)
    star = stars(nodes.points, neighbours, fixed)
    weights = mean_value_weights(star)
    places = _solved(nodes, star, weights)
    for _ in range(LINK_ROUNDS):
        cut = link_weights(star, nodes.points, places)
        if (cut == 1).all():
            break
        places = _solved(nodes, star, weights * cut)
    stretch, spread = area_stretch(star, nodes.points, places, fixed)
    for _ in range(reweightings):
        weights = weights / stretch[star.members]
        trial = _solved(nodes, star, weights * link_weights(star, nodes.points, places))
        stretch, found = area_stretch(star, nodes.points, trial, fixed)
        if not found < spread:
            break
        places, spread = trial, found
    result = nodes.place.copy()
    result[nodes.free] = places[fixed:]
    return result


def _nodes(points: np.ndarray, sides: list[np.ndarray]) -> _Nodes:
    from scipy.spatial import cKDTree

    spacing = np.inf
    if len(points) > 1:
        spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    rims = [densify(x, max(len(x), int(min(chord_lengths(x)[-1] / spacing, MOST_NODES)))) for x in sides]
    places = []
    for k, rim in enumerate(rims):
        along, across = chord_lengths(rim) / chord_lengths(rim)[-1], np.full(len(rim), float(k % 2))
        places.append(np.stack([along, across] if k < 2 else [across, along], axis=1))
    whole, place = np.concatenate(rims), np.concatenate(places)
    far, nearest = cKDTree(whole).query(points)
    away = far > max(COINCIDENT * min(spacing, 1.0), LEAST_COINCIDENT)
    kept = np.arange(len(whole))
    if away.any():
        parts = np.split(cKDTree(points[away]).query(whole)[0], np.cumsum([len(x) for x in rims[:-1]]))
        kept = np.flatnonzero(np.concatenate([_spaced(x, r) for x, r in zip(rims, parts, strict=True)]))
    nodes, first = np.unique(whole[kept], axis=0, return_index=True)
    return _Nodes(np.concatenate([nodes, points[away]]), place[kept][first], away, place[nearest])


def _spaced(rim: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Which vertices to keep, so that no two are much closer than the cloud is to them."""
    arc, kept = chord_lengths(rim), np.zeros(len(rim), bool)
    kept[[0, -1]], last = True, 0
    for k in range(1, len(rim) - 1):
        if arc[k] - arc[last] >= NODE_SPACING * room[k]:
            kept[k], last = True, k
    return kept


def _solved(nodes: _Nodes, star: Stars, weights: np.ndarray) -> Float[Any, "nodes 2"]:
    """Parameters of all nodes with these weights."""
    from scipy.sparse import csr_array, diags_array, eye_array

    count, fixed = len(nodes.points), len(nodes.fixed)
    i = np.repeat(np.arange(count), star.filled.sum(axis=1))
    weights = weights / weights.sum(axis=1, keepdims=True)
    graph = csr_array((weights[star.filled], (i, star.members[star.filled])), shape=(count, count))
    graph = _connect_components(graph, nodes.points, fixed)
    graph = diags_array(1 / graph.sum(axis=1)) @ graph
    if count == fixed:
        return nodes.fixed
    free = graph[fixed:]
    system = eye_array(count - fixed) - free[:, fixed:]
    inner = solved_on_diagonal(system, free[:, :fixed] @ nodes.fixed)
    return np.concatenate([nodes.fixed, np.clip(inner, 0.0, 1.0)])


def _connect_components(graph: Any, points: np.ndarray, fixed: int) -> Any:
    """The graph with links for groups of points from which no path leads to the boundary."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    lost = ~_is_connected_to_boundary(graph, fixed)
    if not lost.any():
        return graph
    rows, rest = np.flatnonzero(lost), np.flatnonzero(~lost)
    inside = graph[rows][:, rows]
    groups, group = connected_components(inside, directed=False)
    far, nearest = cKDTree(points[rest]).query(points[rows])
    order = np.lexsort((far, group))
    first = order[np.searchsorted(group[order], np.arange(groups))]
    links = (np.ones(groups), (rows[first], rest[nearest[first]]))
    back = inside.T.tocoo()  # both ways, so that every point of the group reaches the link
    both = csr_array((back.data, (rows[back.coords[0]], rows[back.coords[1]])), shape=graph.shape)
    return graph + both + csr_array(links, shape=graph.shape)


def _is_connected_to_boundary(graph: Any, fixed: int) -> np.ndarray:
    """Whether a path along the neighbours leads from each point to the boundary."""
    from scipy.sparse import csr_array, vstack
    from scipy.sparse.csgraph import breadth_first_order

    count = graph.shape[0]
    ends = csr_array(np.concatenate([np.ones(fixed), np.zeros(count - fixed)])[None])
    start = vstack([graph.T, ends]).tocsr()  # one more node, which leads to the whole boundary
    square = csr_array((start.data, start.indices, start.indptr), shape=(count + 1, count + 1))
    found = np.zeros(count + 1, bool)
    found[breadth_first_order(square, count, return_predecessors=False)] = True
    return found[:count]
