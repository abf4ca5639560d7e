"""Tangent planes on a grid of parameters, and where neighbours among them face opposite ways."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._quality._host_derivatives import HostDerivatives

Pairs = tuple[Int[np.ndarray, "pairs 2"], Int[np.ndarray, "pairs 2"]]


class TangentPlanes(NamedTuple):
    """An orthonormal pair of tangents at each sample, and how the parameter lines meet there.

    `regular` samples have a tangent plane beyond rounding. `crossed` are those whose parameter lines both
    have a tangent, be they parallel; only they have an `angle`, from 0 to pi/2, and a `ratio` |R_u| / |R_v|.
    """

    first: Float[np.ndarray, "d a b"]
    second: Float[np.ndarray, "d a b"]
    regular: Bool[np.ndarray, "a b"]
    crossed: Bool[np.ndarray, "a b"]
    angle: Float[np.ndarray, "a b"]
    ratio: Float[np.ndarray, "a b"]


def tangent_planes(derivatives: HostDerivatives) -> TangentPlanes:
    """By Gram and Schmidt, which needs no normal and works in every dimension."""
    along_u, along_v = derivatives(1, 0), derivatives(0, 1)
    least_u, least_v = derivatives.rounding(0)[:, None], derivatives.rounding(1)[None, :]
    length_u, length_v = _length(along_u), _length(along_v)
    first = along_u / _nonzero(length_u)
    shear = _dot(along_v, first)
    across = along_v - shear * first
    height = _length(across)
    # The area of the parallelogram of the tangents against its own uncertainty.
    regular = length_u * height > least_u * length_v + least_v * length_u
    crossed = (length_u > least_u) & (length_v > least_v)
    angle = np.arctan2(height, np.abs(shear))
    return TangentPlanes(
        first, across / _nonzero(height), regular, crossed, angle, length_u / _nonzero(length_v)
    )


def find_folds(planes: TangentPlanes) -> Pairs:
    """Pairs of neighbouring samples, as indices (i, j), whose tangent planes are more than 90 degrees apart.

    A sample without a tangent plane is passed over, and its neighbours on both sides are compared.
    """
    along_u = _folds_along_rows(planes.first, planes.second, planes.regular)
    turned = (np.swapaxes(x, -1, -2) for x in planes[:3])
    along_v = [pairs[:, ::-1] for pairs in _folds_along_rows(*turned)]
    here, there = (np.concatenate(x) for x in zip(along_u, along_v, strict=True))
    return here, there


def _folds_along_rows(first: np.ndarray, second: np.ndarray, regular: np.ndarray) -> Pairs:
    """Folds between samples of consecutive rows."""
    rows, columns = regular.shape
    numbers = np.where(regular, np.arange(rows)[:, None], -1)
    before = np.maximum.accumulate(numbers, axis=0)[:-1]  # the last regular sample, -1 for none
    at = np.maximum(before, 0), np.arange(columns)
    e, f, later_e, later_f = first[:, *at], second[:, *at], first[:, 1:], second[:, 1:]
    # The inner product of two planes is Gram's determinant; in space, that of their normals.
    cosine = _dot(e, later_e) * _dot(f, later_f) - _dot(e, later_f) * _dot(f, later_e)
    i, j = np.nonzero((cosine < 0) & regular[1:] & (before >= 0))
    return np.stack([before[i, j], j], axis=1), np.stack([i + 1, j], axis=1)


def group_folds(shape: tuple[int, int], here: np.ndarray, there: np.ndarray) -> Int[np.ndarray, " pairs"]:
    """For each fold the number of its group, a connected patch of samples, the group of most folds first."""
    from scipy.ndimage import label

    folded = np.zeros(shape, bool)
    for ends in (here, there):
        folded[ends[:, 0], ends[:, 1]] = True
    patches = label(folded, np.ones((3, 3)))[0][here[:, 0], here[:, 1]]
    names, number, count = np.unique(patches, return_inverse=True, return_counts=True)
    rank = np.empty(len(names), np.int64)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(names))
    return rank[number]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=0)


def _length(a: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(a, a))


def _nonzero(length: np.ndarray) -> np.ndarray:
    return np.where(length > 0, length, 1.0)
