"""Whether the errors of points whose feet are neighbours are those of noise, or of a net too coarse."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit._cores import cores
from jaxfit._fit._result import Fit

PATCH = 9  # points: one and those with the nearest feet
LONGEST = 3.0  # times the median error: as long as an outlier counts


class ErrorsOfNeighbours(NamedTuple):
    """What points with neighbouring feet have in common.

    `farthest` is the greatest median of the errors of a patch, a point and those with the nearest feet:
    single outliers, that have good points beside their feet, leave it alone. `correlation` is that of the
    vectors from the surface to a point and to the one with the nearest foot: near 0 for noise, near 1 where
    the net is too coarse.
    """

    farthest: float
    correlation: float


def errors_of_neighbours(fit: Fit, points: Float[np.ndarray, "points d"]) -> ErrorsOfNeighbours:
    """Both for the points that were fitted; the vectors of outliers are shortened."""
    from scipy.interpolate import NdBSpline
    from scipy.spatial import KDTree

    surface, feet = fit.surface, np.stack([np.asarray(x, float) for x in (fit.u, fit.v)], axis=1)
    spans = [n / float(end - begin) for n, (begin, end) in zip(surface.shape, surface.domain, strict=True)]
    places = np.nan_to_num(feet) * spans  # of a fit that has diverged, whose errors are not finite either
    beside = KDTree(places, balanced_tree=False).query(places, PATCH, workers=cores())[1]
    farthest = np.median(np.asarray(fit.errors)[beside], axis=1).max()
    knots = np.asarray(surface.knots_u, float), np.asarray(surface.knots_v, float)
    spline = NdBSpline(knots, np.asarray(surface.control_points, float), tuple(k - 1 for k in surface.order))
    away = points - spline(feet)
    length, least = np.linalg.norm(away, axis=1), np.finfo(float).tiny
    away *= (np.minimum(length, LONGEST * np.median(length)) / np.maximum(length, least))[:, None]
    alike = (away * away[beside[:, 1]]).sum() / max((away**2).sum(), least)
    return ErrorsOfNeighbours(float(farthest), float(alike))
