"""The default base surface."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxfit._base._base_method import AbstractBaseMethod
from jaxfit._base._base_surface import base_surface
from jaxfit._base._boundary import Boundary, diagonal
from jaxfit._base._directed_projection import mean_distance
from jaxfit._base._meshless import Meshless
from jaxfit._splines import BSplineSurface

FAR = 5e-3  # of the diagonal: where feet on a blend of the sides are likely to be wrong ones


def default_base(
    boundary: Boundary,
    points: Float[np.ndarray, "points d"],
    net: tuple[int, int],
    order: tuple[int, int],
    meshless: Callable[[], AbstractBaseMethod] = Meshless,
) -> BSplineSurface:
    """The Coons surface, or where that is far from the cloud on average the meshless one, if it is nearer."""
    coons = base_surface(boundary, points, net=net, order=order)
    if points.shape[1] != 3:
        return coons
    distance = mean_distance_to(coons, points)
    if distance <= FAR * diagonal(points):
        return coons
    other = base_surface(boundary, points, net=net, order=order, method=meshless())
    return other if mean_distance_to(other, points) < distance else coons


def mean_distance_to(surface: BSplineSurface, points: Float[np.ndarray, "points 3"]) -> float:
    """Mean distance of the points, computed about their centre, which keeps digits."""
    middle = points.mean(axis=0, dtype=np.float64)
    net = np.asarray(surface.control_points, np.float64) - middle
    knots = (np.asarray(surface.knots_u, np.float64), np.asarray(surface.knots_v, np.float64))
    return mean_distance(net, knots, surface.order, points.astype(np.float64) - middle)
