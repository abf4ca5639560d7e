"""Which points of a scan are left out of the sheet, and why."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._cores import cores, on_all_cores

NEIGHBOURS = 16
PLANES = 4  # times the plane through the neighbours is laid; each time, those far from it count less
FAR = 4.0  # times the usual distance of neighbours: a point with nobody near,
ALOFT = 0.2  # if it is off their plane by so much of its own distance from them,
SPARSE = 2.0  # or that is so many times what
COMMON = 0.95  # of all points have at most: the cloud is nowhere so sparse
STREWN = 5.0  # times the median distance of neighbours: of points that are off their plane
STREWN_ALOFT = 0.3  # by so much of it, too
ROUNDS = 4  # most: each finds most of the points that are strewn about
OFF_USUAL = 8.0  # times the median height of the neighbours over their own planes,
OFF_MOST = 4.0  # times what four in five of them stay below,
OFF_SPACING = 0.4  # times the distance of neighbours: all three for a point off the plane of its neighbours
ROUNDING = 1e-9  # of the diagonal: a height so small is none
BLOCK = 1 << 13  # points at once, on each core


class Cleaned(NamedTuple):
    """Numbers of the points that are kept, and how many are not."""

    kept: Int[np.ndarray, " kept"]
    duplicates: int
    outliers: int


def cleaned(points: Float[Any, "points 3"]) -> Cleaned:
    """Without points that are not finite, exact duplicates and outliers.

    An outlier has no neighbours within several times the usual distance, or lies off the plane of its
    neighbours: by much more than they lie off theirs. An edge is no outlier, for there neighbours lie off
    their planes as well; nor is a point on the plane of denser ones, where a sheet turns sparse. Points that
    are strewn about the sheet are each other's neighbours: they are many times as sparse as the cloud, and
    make no planes.
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    _, first = np.unique(points[finite], axis=0, return_index=True)
    distinct = finite[np.sort(first)]
    kept = distinct
    for _ in range(ROUNDS):
        if len(kept) <= NEIGHBOURS:
            break
        single, strewn = _outliers(points[kept])
        kept = kept[~(single | strewn)]
        if not strewn.any():
            break
    return Cleaned(kept, len(finite) - len(distinct), len(distinct) - len(kept))


def _outliers(points: np.ndarray) -> tuple[Bool[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Those that differ from their neighbours, and those that are strewn about."""
    from scipy.spatial import cKDTree

    middle = points - points.mean(axis=0)
    distance, near = cKDTree(middle).query(middle, NEIGHBOURS + 1, workers=cores())
    near, reach = near[:, 1:], distance[:, NEIGHBOURS // 3 + 1]
    blocks = [slice(k, k + BLOCK) for k in range(0, len(near), BLOCK)]
    height = np.concatenate(on_all_cores(lambda x: _heights(middle[x], middle[near[x]]), blocks))
    usual, most, spacing = (
        np.concatenate(on_all_cores(partial(_quantiles, x, share, near), blocks))
        for x, share in ((height, 0.5), (height, 0.8), (reach, 0.5))
    )
    least = ROUNDING * np.linalg.norm(np.ptp(middle, axis=0))
    off = (height > OFF_USUAL * usual) & (height > OFF_MOST * most) & (height > OFF_SPACING * spacing + least)
    far = reach > FAR * spacing + least
    strewn = (reach > STREWN * np.median(reach)) & (height > STREWN_ALOFT * reach)
    return off | far & ((height > ALOFT * reach) | (reach > SPARSE * np.quantile(reach, COMMON))), strewn


def _quantiles(x: np.ndarray, share: float, near: np.ndarray, part: slice) -> Float[np.ndarray, " points"]:
    """Of the numbers `x` of the neighbours of some points."""
    return np.quantile(x[near[part]], share, axis=1)


def _heights(points: Float[Any, "points 3"], near: Float[Any, "points near 3"]) -> Float[Any, " points"]:
    """How far each point is from the plane through its neighbours, those far from the plane counting less."""
    weight = np.ones(near.shape[:2])
    least = ROUNDING * np.abs(near).max() + np.finfo(float).tiny
    for _ in range(PLANES):
        centre = np.sum(weight[..., None] * near, axis=1) / weight.sum(axis=1, keepdims=True)
        steps = near - centre[:, None]
        covariance = np.swapaxes(steps * weight[..., None], 1, 2) @ steps
        normal = np.linalg.eigh(covariance)[1][:, :, :1]
        height = np.abs(steps @ normal)[..., 0]
        usual = np.median(height, axis=1, keepdims=True)
        weight = 1 / (1 + (height / np.maximum(2 * usual, least)) ** 2) ** 2
    return np.abs(np.sum((points - centre) * normal[..., 0], axis=1))
