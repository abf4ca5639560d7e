"""Delaunay stars of scattered points, each in its own tangent plane, and mean-value weights on them.

The neighbours of a point p in a planar Delaunay triangulation are the corners of the convex hull of all
other points inverted at p, q -> (q - p) / |q - p|^2 (circles through p become lines). That hull is found
for all points at once by dropping, from neighbours sorted by angle, those inside the triangle of p and
their two neighbours, until none is left: a few passes over arrays (points, width), no triangulation.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._base._point_normals import oriented, principal_axes, supported_axes

TIES = 1e-9  # neighbours this much farther (relatively) than the last one still belong: ties are ties
SPARE = 16  # of which there may be so many
MOST_WIDTH = 4  # times the neighbours asked for: the most that symmetry may add
COCIRCULAR = 1e-7  # sine of an angle of the hull that still counts as straight
SLOPE_POWER = 3  # powers of the cosine that a step out of the plane is lengthened by
LEAST_COSINE = 0.05  # the least such cosine
WIDEST = np.deg2rad(150.0)  # a gap between neighbours counts as no wider than this
# Points with a wide gap that may be neighbours across it: few, and then many where more than half a turn is
# still free. Less than that has a triangle, if a thin one, as on scan lines.
ACROSS = (100, WIDEST), (1000, np.pi)
ENTRIES = 1 << 20  # of arrays at once, in the search for these
SECTORS = 180  # of the circle, of which many neighbours are the nearest


class Stars(NamedTuple):
    """For every point its star, in order of angle, padded at the end."""

    members: Int[Any, "points width"]  # numbers of the neighbours
    filled: Bool[Any, "points width"]
    plane: Float[Any, "points width 2"]  # where they lie around the point, at their true distances
    angle: Float[Any, "points width"]  # from each to the next, at most 2 pi


class Planes(NamedTuple):
    """Points with the axes of their tangent planes, and in space normals to one side."""

    points: np.ndarray  # (points, d)
    axes: np.ndarray  # (points, d, 2)
    normals: np.ndarray | None  # (points, 3)


def stars(
    points: Float[Any, "points d"],
    count: int,
    fixed: int = 0,
    planes: Planes | None = None,
    straight: float = COCIRCULAR,
) -> Stars:
    """The stars among about `count` neighbours, d >= 2, in given planes or in those of as many neighbours; no
    two points may coincide.

    Where an angle of a hull is straight, to a sine of `straight`, points lie on a circle, and all are
    neighbours. Of two in the same direction, to that sine, the farther one is none.

    Points with a wide gap, except the first `fixed` ones, get a second search among all points that have one,
    and a third one if the gap stays: the points on the rim of a hole are then neighbours across it. Otherwise
    the hole would grow.
    """
    members, filled = neighbourhoods(points, count)
    planes = _planes(points, members, filled) if planes is None else planes
    star = _stars_among(planes, np.arange(len(points)), members, filled, straight)
    gaping = np.flatnonzero((star.angle > WIDEST).any(axis=1))
    for across, widest in ACROSS:
        rows = gaping[(gaping >= fixed) & (star.angle[gaping] > widest).any(axis=1)]
        most = min(len(gaping), across)
        at_once = max(ENTRIES // (most + 1), 1)
        for k in range(0, len(rows), at_once):
            part = rows[k : k + at_once]
            members, filled = _with_nearest(star, points, part, gaping, most)
            star = _replaced(star, part, _stars_among(planes, part, members, filled, straight))
    return star


def _stars_among(
    planes: Planes, rows: np.ndarray, members: np.ndarray, filled: np.ndarray, straight: float
) -> Stars:
    """The stars of the points `rows` among given ones."""
    plane = _in_tangent_planes(planes, rows, members, filled)
    angle = np.arctan2(plane[..., 1], plane[..., 0])
    if members.shape[1] > SECTORS:
        filled = filled & _nearest_in_sector(angle, _norm(plane), filled)
    angle = np.where(filled, angle, np.inf)
    order = np.argsort(angle, axis=1, kind="stable")
    members, filled, plane = _reordered((members, filled, plane), order)
    members, filled, plane = _hulls(members, filled, plane, straight)
    return Stars(members, filled, plane, _angles_between(plane, filled))


def _nearest_in_sector(angle: np.ndarray, far: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """Which neighbours are nearest in their sector. Along lines hundreds are in convex position when they are
    inverted, and most in hardly different directions.
    """
    sector = np.floor((angle + np.pi) * (SECTORS / (2 * np.pi)))
    order = np.lexsort((far, np.where(filled, sector, np.inf)), axis=1)
    first = np.diff(np.take_along_axis(sector, order, axis=1), axis=1, prepend=-1.0) != 0
    nearest = np.zeros_like(filled)
    np.put_along_axis(nearest, order, first, axis=1)
    return nearest


def _with_nearest(
    star: Stars, points: np.ndarray, rows: np.ndarray, others: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The members of these stars, and what is not among them of the `count` nearest of the `others`."""
    from scipy.spatial import cKDTree

    near = cKDTree(points[others]).query(points[rows], count)[1]
    near = others[near.reshape(len(rows), -1)]
    members, filled = star.members[rows], star.filled[rows]
    known = near == rows[:, None]
    for k in range(members.shape[1]):
        known |= filled[:, k, None] & (near == members[:, k, None])
    return np.concatenate([members, near], axis=1), np.concatenate([filled, ~known], axis=1)


def _replaced(star: Stars, rows: np.ndarray, part: Stars) -> Stars:
    """With other stars of some points; all as wide as the widest."""
    width = max(star.members.shape[1], part.members.shape[1])

    def both(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old, new = (
            np.pad(x, [(0, 0), (0, width - x.shape[1])] + [(0, 0)] * (x.ndim - 2)) for x in (old, new)
        )
        old[rows] = new
        return old

    return Stars(*(both(old, new) for old, new in zip(star, part, strict=True)))


def neighbourhoods(
    points: Float[Any, "points d"], count: int
) -> tuple[Int[Any, "points width"], Bool[Any, "points width"]]:
    """Numbers of near points, nearest first, and which entries are filled.

    Two points are neighbours if either is among the `count` nearest of the other. The nearest alone all
    lie on one side where the density changes; made symmetric, they reach into the thin side as well.
    """
    from scipy.spatial import cKDTree

    asked = min(count + 1 + SPARE, len(points))
    distance, near = cKDTree(points).query(points, asked)
    own = np.arange(len(points))
    reach = distance[:, min(count, asked - 1)] * (1 + TIES)
    within = (distance <= reach[:, None]) & (near != own[:, None])
    i, j = np.repeat(own, within.sum(axis=1)), near[within]
    far = distance[within]
    i, j, far = np.concatenate([i, j]), np.concatenate([j, i]), np.concatenate([far, far])
    pairs, first = np.unique(i * len(points) + j, return_index=True)
    i, j, far = pairs // len(points), pairs % len(points), far[first]
    order = np.lexsort((far, i))
    i, j = i[order], j[order]
    place = np.arange(len(i)) - np.searchsorted(i, own)[i]
    kept = place < MOST_WIDTH * count
    width = int(place[kept].max()) + 1
    members = np.zeros((len(points), width), int)
    filled = np.zeros((len(points), width), bool)
    members[i[kept], place[kept]] = j[kept]
    filled[i[kept], place[kept]] = True
    return members, filled


def _planes(points: np.ndarray, members: np.ndarray, filled: np.ndarray) -> Planes:
    unit, weight = _weighted(points, members, filled)
    axes = principal_axes(unit, weight)
    normals = oriented(axes[:, :, 0], unit, members, filled) if points.shape[1] == 3 else None
    return Planes(points, axes[:, :, -2:], normals)


def _weighted(points: np.ndarray, members: np.ndarray, filled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions of the neighbours, and by how much each counts: less the farther it is."""
    far, unit = _directions(points, np.arange(len(points)), members, filled)
    nearest = np.where(filled, far, np.inf).min(axis=1, keepdims=True)
    return unit, np.where(filled, nearest / far, 0.0)


def supported_planes(points: Float[Any, "points 3"], count: int) -> Planes:
    """Tangent planes by about `count` neighbours, of which some may be on another sheet that is as near."""
    members, filled = neighbourhoods(points, count)
    unit, weight = _weighted(points, members, filled)
    axes = supported_axes(unit, weight, members, filled)
    return Planes(points, axes[:, :, -2:], oriented(axes[:, :, 0], unit, members, filled))


def _directions(
    points: np.ndarray, rows: np.ndarray, members: np.ndarray, filled: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances and unit directions of the neighbours of the points `rows`."""
    steps = points[members] - points[rows][:, None]
    far = np.where(filled, np.linalg.norm(steps, axis=2), 1.0)
    return far, np.where(filled[..., None], steps / far[..., None], 0.0)


def _in_tangent_planes(
    planes: Planes, rows: np.ndarray, members: np.ndarray, filled: np.ndarray
) -> np.ndarray:
    """Neighbours in the tangent plane: the direction is projected, the distance kept or lengthened.

    It is divided by the cosine of the slope of the step, `SLOPE_POWER` times over, and likewise where the
    normals point away from each other: a point on the sheet below is as near as those beside, and must be
    farther; on a ridge, where there are no others, it stays a neighbour.
    """
    far, unit = _directions(planes.points, rows, members, filled)
    flat = unit @ planes.axes[rows]
    length = _norm(flat)
    cosine = np.maximum(length, LEAST_COSINE)
    if planes.normals is not None:
        agree = 1 + np.sum(planes.normals[members] * planes.normals[rows][:, None], axis=2)
        cosine = cosine * np.clip(agree, LEAST_COSINE, 1.0)
    return flat * (far / (np.where(length > 0, length, 1.0) * cosine**SLOPE_POWER))[..., None]


def _reordered(arrays: tuple[np.ndarray, ...], order: np.ndarray) -> list[np.ndarray]:
    """Each row of each array in the order given."""
    return [np.take_along_axis(x, order.reshape(*order.shape, *[1] * (x.ndim - 2)), axis=1) for x in arrays]


def _hulls(
    members: np.ndarray, filled: np.ndarray, plane: np.ndarray, straight: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drop the neighbours that are no Delaunay neighbours. Those that are filled come first."""
    flipped = _inverted(plane)
    rows = np.arange(len(members))  # those in which something was dropped last time
    while len(rows):
        most = int(filled[rows].sum(axis=1).max())  # soon much less than the width
        part, there = flipped[rows, :most], filled[rows, :most]
        before, after = cyclic_neighbours(part, there)
        turn = _cross(part - before, after - part)
        size = _norm(part - before) * _norm(after - part)
        # Across half a turn or more there is no triangle that could hide the point.
        opposite = _cross(before, after) <= straight * _norm(before) * _norm(after)
        dropped = there & ((~opposite & (turn < -straight * size)) | _is_hidden(part, before, straight))
        dropped |= there & _is_hidden(part, after, straight)
        # A point whose two neighbours are one and the same stays.
        dropped &= (there.sum(axis=1) > 2)[:, None]
        changed = dropped.any(axis=1)
        rows, there = rows[changed], (there & ~dropped)[changed]
        order = np.argsort(~there, axis=1, kind="stable")
        filled[rows, :most] = np.take_along_axis(there, order, axis=1)
        for x in (members, plane, flipped):
            x[rows, :most] = _reordered((x[rows, :most],), order)[0]
    width = int(filled.sum(axis=1).max())
    return members[:, :width], filled[:, :width], plane[:, :width]


def share_on_circles(star: Stars, straight: float) -> float:
    """The share of stars of which a neighbour lies on a circle with the two beside it and the point itself,
    to a sine of `straight`.
    """
    flipped = _inverted(star.plane)
    before, after = cyclic_neighbours(flipped, star.filled)
    turn = _cross(flipped - before, after - flipped)
    size = _norm(flipped - before) * _norm(after - flipped)
    between = star.filled & (star.filled.sum(axis=1) > 2)[:, None]
    return float((between & (np.abs(turn) <= straight * size)).any(axis=1).mean())


def _inverted(plane: np.ndarray) -> np.ndarray:
    square = _dot(plane, plane)
    return plane / np.where(square > 0, square, 1.0)[..., None]


def cyclic_neighbours(
    x: Float[Any, "points width ..."] | Int[Any, "points width"], filled: Bool[Any, "points width"]
) -> list[Any]:
    """The entry before and the entry after each, going round; filled entries come first in each row."""
    count = np.maximum(filled.sum(axis=1), 1)[:, None]
    place = np.arange(filled.shape[1])[None, :]
    return [_reordered((x,), (place + shift) % count)[0] for shift in (-1, 1)]


def _is_hidden(x: np.ndarray, other: np.ndarray, straight: float) -> np.ndarray:
    """Whether x, inverted, is in the same direction as the other, and was farther away."""
    size = _norm(x) * _norm(other)
    along = (np.abs(_cross(x, other)) <= straight * size) & (_dot(x, other) > 0)
    return along & (_norm(x) < _norm(other))


def _norm(x: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(x, x))


def _dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    # Written out: NumPy is several times slower in sums over an axis of two.
    return x[..., 0] * y[..., 0] + x[..., 1] * y[..., 1]


def _cross(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]


def _angles_between(plane: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """Angle from each neighbour to the next; a single neighbour leaves a gap of a full turn."""
    after = cyclic_neighbours(plane, filled)[1]
    angle = np.arctan2(_cross(plane, after), _dot(plane, after))
    alone = filled.sum(axis=1, keepdims=True) == 1
    return np.where(filled, np.where(alone, 2 * np.pi, angle % (2 * np.pi)), 0.0)


def mean_value_weights(star: Stars) -> Float[Any, "points width"]:
    r"""Positive weights $(\tan(\alpha_{k-1}/2) + \tan(\alpha_k/2)) / r_k$ of the neighbours, not normalised.

    With $\alpha$ the angles to the neighbours before and after and r the distance, a point in the plane
    is the mean of its neighbours with them. Gaps count as at most `WIDEST`, so that weights
    stay positive and do not jump where a gap passes half a turn.

    Source: M. S. Floater, Mean value coordinates, Computer Aided Geometric Design 20 (2003).
    """
    half = np.tan(np.minimum(star.angle, WIDEST) / 2)
    before = cyclic_neighbours(half[..., None], star.filled)[0][..., 0]
    far = _norm(star.plane)
    return np.where(star.filled, (before + half) / np.where(star.filled, far, 1.0), 0.0)
