"""Base surfaces at given parameters, without a boundary: the thin plate decides where the border is."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._host_splines import Knots
from jaxfit._base._regular_net import regular_net
from jaxfit._base._thin_plate_fit import ThinPlateFit
from jaxfit._precision import working_dtype
from jaxfit._splines import BSplineSurface

SMOOTHING = 0.1  # as `Meshless` has it: details about as wide as a knot span are smoothed away
ROBUST = 3  # rounds in which far points lose weight


def base_at_parameters(
    points: Float[Any, "points d"],
    parameters: Float[Any, "points 2"],
    knots: Knots,
    order: tuple[int, int],
) -> BSplineSurface:
    """A smoothed surface at given parameters in the unit square.

    Beyond the points the thin plate goes on straight. Needs three points that are not in line.
    """
    centre = points.mean(axis=0)
    middle = points - centre
    size = float(np.linalg.norm(np.ptp(middle, axis=0)))
    net = [len(t) - k for t, k in zip(knots, order, strict=True)]
    start = np.zeros((*net, points.shape[1]))
    fit = ThinPlateFit(start, knots, order, parameters, middle / size, free_border=True)
    reach = float(np.linalg.norm(middle, axis=1).max()) / size
    found = regular_net(fit, SMOOTHING, ROBUST, reach) * size + centre
    dtype = working_dtype()
    return BSplineSurface(found.astype(dtype), *(x.astype(dtype) for x in knots))
