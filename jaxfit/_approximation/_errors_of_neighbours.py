"""Whether the errors of points whose feet are neighbours are those of noise, or of a net too coarse."""

import numpy as np
from jaxtyping import Float, Int

from jaxfit._fit._result import Fit

PATCH = 9  # points: one and those with the nearest feet
LONGEST = 3.0  # times the median error: as long as an outlier counts


def farthest_patch(fit: Fit) -> float:
    """The greatest median of the errors of a point and of those with the nearest feet: single outliers, that
    have good points beside their feet, leave it alone.
    """
    return float(np.median(np.asarray(fit.errors)[_beside(fit, PATCH)], axis=1).max())


def likeness_of_neighbours(fit: Fit, points: Float[np.ndarray, "points d"]) -> float:
    """The correlation of the vectors from the surface to points and to those with the next feet, the longest
    ones shortened: outliers are not to decide.
    """
    from scipy.interpolate import NdBSpline

    surface = fit.surface
    knots = np.asarray(surface.knots_u, float), np.asarray(surface.knots_v, float)
    spline = NdBSpline(knots, np.asarray(surface.control_points, float), tuple(k - 1 for k in surface.order))
    away = points - spline(np.stack([np.asarray(fit.u, float), np.asarray(fit.v, float)], axis=1))
    length = np.linalg.norm(away, axis=1)
    away *= (np.minimum(length, LONGEST * np.median(length)) / np.maximum(length, np.finfo(float).tiny))[
        :, None
    ]
    return float((away * away[_beside(fit, 2)[:, 1]]).sum() / max((away**2).sum(), np.finfo(float).tiny))


def _beside(fit: Fit, count: int) -> Int[np.ndarray, "points count"]:
    """The points with the nearest feet, each first its own."""
    from scipy.spatial import KDTree

    sides = zip((fit.u, fit.v), fit.surface.domain, fit.surface.shape, strict=True)
    feet = np.stack([np.asarray(x) * (n / float(end - begin)) for x, (begin, end), n in sides], axis=1)
    feet = np.nan_to_num(feet)  # of a fit that has diverged, whose errors are not finite either
    return KDTree(feet, balanced_tree=False).query(feet, count, workers=-1)[1]
