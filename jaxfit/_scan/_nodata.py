"""Points whose coordinates are a number that stands for no data."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

# What rasters and instruments write where they have not measured: numbers of nines, the ends of 16 bits, and
# anything near those of single precision.
USUAL = -999.0, *(sign * x for x in (9999.0, 99999.0, 999999.0, 32767.0, 32768.0) for sign in (-1, 1))
HUGE = 1e20
APART = 2.0  # times the range of all other coordinates: farther than that from these


def check_measured(name: str, points: Float[Any, "points d"], advice: str) -> None:
    """Raise if some of the points stand for no data."""
    missing = is_nodata(np.asarray(points, np.float64))  # half precision overflows
    if missing.any():
        first = points[np.argmax(missing)]
        raise ValueError(
            f"{name} must hold measured points only, but {int(missing.sum()):,} have a coordinate that "
            f"stands for no data, the first ({', '.join(f'{x:g}' for x in first)}); {advice}."
        )


def is_nodata(points: Float[Any, "points d"]) -> Bool[np.ndarray, " points"]:
    """Where a coordinate is such a number, far from all others."""
    found = np.zeros(len(points), bool)
    ends = np.stack([np.fmin.reduce(points), np.fmax.reduce(points)]) if len(points) else points
    if np.isfinite(ends).all() and not _is_marked(ends).any():
        return found  # as most: what is far from all others is an end
    marked = _is_marked(points)
    for x, some in zip(points.T, marked.T, strict=True):
        others = x[np.isfinite(x) & ~some]
        if not some.any() or not len(others):
            continue
        low, high = float(others.min()), float(others.max())
        found |= some & (np.maximum(x - high, low - x) > APART * (high - low))
    return found


def _is_marked(x: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Where a number is one of those."""
    with np.errstate(invalid="ignore"):
        return (np.isin(x, USUAL) | (np.abs(x) >= HUGE)) & np.isfinite(x)
