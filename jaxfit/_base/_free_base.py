"""Base surfaces at given parameters, without a boundary: the thin plate decides where the border is."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._smoothed_net import smoothed_net
from jaxfit._base._thin_plate_fit import ThinPlateFit
from jaxfit._precision import working_dtype
from jaxfit._splines import BSplineSurface, clamped_uniform_knots

SMOOTHING = 0.1  # as `Meshless` has it: details about as wide as a knot span are smoothed away
ROBUST = 3  # rounds in which far points lose weight


def free_base(
    points: Float[Any, "points d"],
    parameters: Float[Any, "points 2"],
    net: tuple[int, int],
    order: tuple[int, int],
) -> BSplineSurface:
    """A smoothed surface at given parameters in the unit square, on uniform knots.

    Beyond the points the thin plate goes on straight. Needs three points that are not in line.
    """
    centre = points.mean(axis=0)
    middle = points - centre
    size = float(np.linalg.norm(np.ptp(middle, axis=0)))
    knots = _uniform_knots(net, order)
    start = np.zeros((*net, points.shape[1]))
    fit = ThinPlateFit(start, knots, order, parameters, middle / size, free_border=True)
    reach = float(np.linalg.norm(middle, axis=1).max()) / size
    return _surface(smoothed_net(fit, SMOOTHING, ROBUST, reach) * size + centre, knots)


def _uniform_knots(net: tuple[int, int], order: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    u, v = (np.asarray(clamped_uniform_knots(n, k), float) for n, k in zip(net, order, strict=True))
    return u, v


def _surface(net: np.ndarray, knots: tuple[np.ndarray, np.ndarray]) -> BSplineSurface:
    dtype = working_dtype()
    return BSplineSurface(net.astype(dtype), *(x.astype(dtype) for x in knots))
