"""Nets of thin-plate fits that are regular rather than close."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._thin_plate_fit import ThinPlateFit
from jaxfit._base._unfolding import unfolded

FARTHEST = 2.0  # times the reach of the points: how far out control points may lie
MOST_RISES = 12  # most rises of the smoothing


def regular_net(fit: ThinPlateFit, smoothing: float, robust: int, reach: float) -> Float[Any, "nu nv d"]:
    """The net with this smoothing, or ten times more until no control point lies far out; then unfolded.

    `reach` is how far out the points are, `robust` in how many rounds they lose weight with their distance.
    """
    for power in range(MOST_RISES):
        raised = smoothing * 10.0**power
        found, weights = fit.robust_weights(raised, robust)
        if np.linalg.norm(found, axis=-1).max() <= FARTHEST * reach:
            break
    return unfolded(fit, found, weights, raised) if found.shape[2] == 3 else found
