"""Normals of scattered points: planes through neighbours, oriented along a spanning tree."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

PLANES = 3  # times the plane is laid; each time, steps out of the last one count less


CERTAIN = 0.9  # of the neighbours flat in the plane of a point: no other plane is tried
CANDIDATES = 16  # neighbours whose planes are tried otherwise
TILTED = np.cos(np.deg2rad(60.0))  # largest cosine with its own plane; less of a tilt may be noise or a bend
LEVEL = 16  # power of the squared cosine of a step by which the neighbour has a say in the sign of a normal
FLATNESS = 8  # power of the squared cosine of its slope by which a neighbour counts as flat in a plane


def principal_axes(
    unit: Float[Any, "points width d"], weight: Float[Any, "points width"], cosine: Any = 1.0
) -> Float[Any, "points d d"]:
    """Principal axes of the weighted unit directions to the neighbours, as columns, the normal first.

    Unit, so that a dense side does not outweigh a thin one by its distances. `cosine` is by how much each
    direction counts at first, its squared cosine with the plane, squared.
    """
    for _ in range(PLANES):
        covariance = np.swapaxes(unit * (weight * cosine)[..., None], 1, 2) @ unit
        axes = np.linalg.eigh(covariance)[1]
        cosine = np.sum((unit @ axes[:, :, -2:]) ** 2, axis=2) ** 2
    return axes


def supported_axes(
    unit: Float[Any, "points width 3"],
    weight: Float[Any, "points width"],
    members: Int[Any, "points width"],
    filled: Bool[Any, "points width"],
) -> Float[Any, "points 3 3"]:
    """The principal axes, found again from the plane of that neighbour in which most others lie flat.

    Where another sheet is as near as the next points, the plane of all of them may lie across both.
    """
    axes = principal_axes(unit, weight)
    normals = axes[:, :, 0]
    flat = _flat(unit, weight, normals)
    rows = np.flatnonzero(flat < CERTAIN * weight.sum(axis=1))
    unit, weight, flat, own = unit[rows], weight[rows], flat[rows], normals[rows]
    found, best = np.zeros(len(rows), bool), own
    for k in range(min(CANDIDATES, members.shape[1])):
        normal = normals[members[rows, k]]
        other = np.where(filled[rows, k], _flat(unit, weight, normal), 0.0)
        better = (other > flat) & (np.abs(np.sum(normal * own, axis=1)) < TILTED)
        found |= better
        flat, best = np.where(better, other, flat), np.where(better[:, None], normal, best)
    cosine = (1 - np.sum(unit * best[:, None], axis=2) ** 2) ** 2
    axes[rows[found]] = principal_axes(unit[found], weight[found], cosine[found])
    return axes


def _flat(unit: np.ndarray, weight: np.ndarray, normals: np.ndarray) -> Float[Any, " points"]:
    """How many neighbours, by weight, lie flat in the planes with these normals."""
    return np.sum(weight * (1 - np.sum(unit * normals[:, None], axis=2) ** 2) ** FLATNESS, axis=1)


def oriented(
    normals: Float[Any, "points 3"],
    unit: Float[Any, "points width 3"],
    members: Int[Any, "points width"],
    filled: Bool[Any, "points width"],
) -> Float[Any, "points 3"]:
    """The normals with signs that agree along a tree of steps within the surface.

    After Hoppe et al. (1992), but with the slope of a step against both planes in its cost: the
    tree goes round an edge from one sheet to the other rather than across the gap. And normals are compared
    with their mirror images in the middle of the step, as on an arc, however far it turns between two points
    (Xie, Wang, Hua, Qin and Kaufman, 2003). In the end a point that most of its neighbours disagree with is
    turned round.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    count = len(normals)
    slope, other = np.sum(unit * normals[:, None], axis=2), np.sum(unit * normals[members], axis=2)
    alike = np.sum(normals[members] * normals[:, None], axis=2) - 2 * slope * other
    steep = np.maximum(slope**2, other**2)
    cost = 1e-9 + steep + 1 - np.minimum(np.abs(alike), 1.0)
    steps = np.broadcast_to(np.arange(count)[:, None], members.shape)[filled], members[filled]
    tree = minimum_spanning_tree(csr_array((cost[filled], steps), shape=(count, count)))
    turns = csr_array((np.where(alike[filled] < 0, -1.0, 1.0), steps), shape=(count, count))
    sign, seen = np.ones(count), np.zeros(count, bool)
    for root in range(count):
        if seen[root]:
            continue
        order, before = breadth_first_order(tree, root, directed=False)
        seen[order] = True
        parents = before[order[1:]]
        for each, parent, turn in zip(order[1:], parents, turns[parents, order[1:]], strict=True):
            sign[each] = sign[parent] * turn
    votes = sign * np.sum(np.where(filled, alike * (1 - steep) ** LEVEL * sign[members], 0.0), axis=1)
    return normals * np.where(votes < 0, -sign, sign)[:, None]
