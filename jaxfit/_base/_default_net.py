"""The default number of control points for a cloud."""

import numpy as np

from jaxfit._base._boundary import Boundary
from jaxfit._base._douglas_peucker import chord_lengths

POINTS_PER_CONTROL_POINT = 8
MOST_CONTROL_POINTS = 64  # per direction


def default_net(count: int, boundary: Boundary, order: tuple[int, int]) -> tuple[int, int]:
    """About one control point for every eight of `count` points, spread by the lengths of the sides.

    At least twice the order and at most 64 in each direction.
    """
    return net_of_size(
        np.sqrt(max(count / POINTS_PER_CONTROL_POINT, 1.0)), boundary, order, MOST_CONTROL_POINTS
    )


def net_of_size(size: float, boundary: Boundary, order: tuple[int, int], most: int) -> tuple[int, int]:
    """About `size` squared control points, spread by the lengths of the sides: at least twice the order and
    at most `most` in each direction."""
    sides = (boundary.v0, boundary.v1, boundary.u0, boundary.u1)
    lengths = [chord_lengths(np.asarray(x, float))[-1] for x in sides]
    ratio = np.sqrt((lengths[0] + lengths[1]) / (lengths[2] + lengths[3]))
    wanted = (round(size * ratio), round(size / ratio))
    nu, nv = (int(np.clip(n, 2 * k, most)) for n, k in zip(wanted, order, strict=True))
    return nu, nv
