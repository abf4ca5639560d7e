"""Numbers of control points: checked ones, and the default for a cloud."""

import operator
from typing import Any

import numpy as np

from jaxfit._base._boundary import Boundary
from jaxfit._base._douglas_peucker import chord_lengths

POINTS_PER_CONTROL_POINT = 8
MOST_CONTROL_POINTS = 64  # per direction
MOST_A_POINT = 16  # control points for each point of a cloud, of nets larger than the largest default one
LARGEST_NET = 10_000_000  # control points in all: a fit of more would not fit in memory


def default_net(count: int, boundary: Boundary, order: tuple[int, int]) -> tuple[int, int]:
    """About one control point for every eight of `count` points, spread by the lengths of the sides.

    At least twice the order and at most 64 in each direction.
    """
    return net_of_size(default_size(count), boundary, order, MOST_CONTROL_POINTS)


def default_size(count: int) -> float:
    """The root of the default number of control points."""
    return float(np.sqrt(max(count / POINTS_PER_CONTROL_POINT, 1.0)))


def net_of_size(size: float, boundary: Boundary, order: tuple[int, int], most: int) -> tuple[int, int]:
    """About `size` squared control points, spread by the lengths of the sides: at least twice the order and
    at most `most` in each direction."""
    sides = (boundary.v0, boundary.v1, boundary.u0, boundary.u1)
    lengths = [chord_lengths(np.asarray(x, float))[-1] for x in sides]
    ratio = np.sqrt((lengths[0] + lengths[1]) / (lengths[2] + lengths[3]))
    return net_of_ratio(size, float(ratio), order, most)


def net_of_ratio(size: float, ratio: float, order: tuple[int, int], most: int) -> tuple[int, int]:
    """The same for a patch whose sides along u are `ratio` squared times as long as those along v."""
    wanted = (round(size * ratio), round(size / ratio))
    nu, nv = (int(np.clip(n, 2 * k, most)) for n, k in zip(wanted, order, strict=True))
    return nu, nv


def checked_net_shape(net: Any, order: tuple[int, int]) -> tuple[int, int]:
    """Control points along u and v as whole numbers that suit the order."""
    try:
        nu, nv = (operator.index(x) for x in net)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"net must be two whole numbers, but is {net!r}; give one for u and one for v."
        ) from error
    if nu < order[0] or nv < order[1]:
        raise ValueError(
            f"net must be at least {order[0]} x {order[1]} control points for order {order}, but "
            f"is {nu} x {nv}; enlarge it or lower the order."
        )
    if nu * nv > LARGEST_NET:
        raise ValueError(
            f"net must have at most {LARGEST_NET} control points, but {nu} x {nv} are asked for; lower it."
        )
    return nu, nv


def check_net_of_cloud(net: tuple[int, int], count: int) -> None:
    """Raise if a net is so much larger than a cloud of `count` points that these say nothing about most of
    it."""
    most = max(MOST_CONTROL_POINTS**2, MOST_A_POINT * count)
    if net[0] * net[1] > most:
        raise ValueError(
            f"net must have at most {most:,} control points for {count:,} points, but {net[0]} x {net[1]} "
            "are asked for; lower it."
        )
