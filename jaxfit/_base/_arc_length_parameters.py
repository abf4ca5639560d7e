"""From chord length along the sides to the parameters of the curves that follow them."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._douglas_peucker import chord_lengths

SAMPLES = 64  # of a side curve, per control point


def parameters_at_arc_length(
    places: Float[Any, "points 2"],
    net: Float[Any, "nu nv d"],
    knots: tuple[Float[Any, " knots_u"], Float[Any, " knots_v"]],
    order: tuple[int, int],
) -> Float[Any, "points 2"]:
    """Parameters at which the sides of the net have these fractions of their lengths; blended inside."""
    u, v = places.T
    low_u, high_u = (_at_length(u, net[:, j], knots[0], order[0]) for j in (0, -1))
    low_v, high_v = (_at_length(v, net[i], knots[1], order[1]) for i in (0, -1))
    return np.stack([(1 - v) * low_u + v * high_u, (1 - u) * low_v + u * high_v], axis=1)


def _at_length(share: np.ndarray, control: np.ndarray, knots: np.ndarray, order: int) -> np.ndarray:
    from scipy.interpolate import BSpline

    fine = np.linspace(knots[0], knots[-1], SAMPLES * len(control) + 1)
    arc = chord_lengths(BSpline(knots, control, order - 1)(fine))
    return np.interp(share, arc / arc[-1], fine)
