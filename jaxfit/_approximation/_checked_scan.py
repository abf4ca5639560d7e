"""Checks of the arguments of `fit_points` without a boundary."""

from typing import Any, NamedTuple

import numpy as np

from jaxfit._approximation._cloud_fit import LEAST_POINTS
from jaxfit._checks import as_points, check_number, is_concrete
from jaxfit._fit._scaling import unit_of
from jaxfit._scan import is_nodata


class ScanInput(NamedTuple):
    """Points that may not be finite, triangles between them, and what counts as a hole."""

    points: np.ndarray  # (points, 3), float64
    nodata: int  # how many of these are NaN now for a number that stands for no data
    faces: np.ndarray | None  # (faces, 3)
    hole_length: float | None


def checked_scan(points: Any, faces: Any, hole_length: Any, base: Any, start: Any) -> ScanInput:
    """The arguments on the host; raises if one is not valid."""
    if not is_concrete(points, faces, hole_length):
        raise TypeError(
            "points must be concrete where no boundary is given, but are traced; call fit_points outside jit."
        )
    if base is not None:
        raise ValueError(
            f"base must be None where no boundary is given, but is {base!r}; leave it out or pass a boundary."
        )
    if start is not None:
        raise ValueError(
            "start must be None where no boundary is given, for parameters are found from the points; leave "
            "it out, or pass a boundary."
        )
    cloud = _points_with_gaps(points)
    missing = is_nodata(cloud)
    cloud = np.where(missing[:, None], np.nan, cloud)
    if hole_length is not None:
        check_number("hole_length", hole_length, 0.0)
        if not hole_length > 0:
            raise ValueError(
                f"hole_length must be positive, but is {hole_length!r}; give a length in the points' unit."
            )
    return ScanInput(
        cloud,
        int(missing.sum()),
        None if faces is None else _checked_faces(faces, len(cloud)),
        None if hole_length is None else float(hole_length),
    )


def _points_with_gaps(points: Any) -> np.ndarray:
    """Points (N, 3) of which some may be NaN or infinite."""
    array, gaps = points, None
    if (numbers := _as_numbers(points)) is not None:
        gaps = ~np.isfinite(numbers)
        array = np.where(gaps, 0, numbers)
    typed = as_points("points", array, 3, least=LEAST_POINTS)
    whole = slice(None) if gaps is None else ~gaps.any(axis=1)
    if len(some := typed[whole]):
        unit_of(some)  # which looks at their precision
    checked = np.asarray(typed, float)
    return checked if gaps is None else np.where(gaps, np.nan, checked)


def _as_numbers(points: Any) -> np.ndarray | None:
    """Points as an array of numbers, or None where `as_points` says what they are."""
    if np.ma.isMaskedArray(points):
        return None
    try:
        array = np.asarray(points)
    except ValueError:  # rows that differ in length
        return None
    return array if array.dtype.kind in "fiub" else None


def _checked_faces(faces: Any, count: int) -> np.ndarray:
    numbers = np.asarray(faces)
    if numbers.dtype.kind not in "iu" or numbers.ndim != 2 or numbers.shape[1] != 3 or not len(numbers):
        raise ValueError(
            f"faces must hold three whole numbers a row, but have shape {numbers.shape} and dtype "
            f"{numbers.dtype}; give the numbers of the corners of each triangle."
        )
    if numbers.min() < 0 or numbers.max() >= count:
        raise ValueError(
            f"faces must hold numbers of points from 0 to {count - 1}, but hold {numbers.min()} to "
            f"{numbers.max()}; number the points from 0."
        )
    return numbers.astype(int)
