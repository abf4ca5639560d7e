"""Clouds on the host: centred, of size one, without duplicates, in an order of their own."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit._base._boundary import Boundary, centre_and_size


class Cloud(NamedTuple):
    """Distinct points and boundary polylines, centred and divided by the size of the boundary."""

    points: Float[Any, "distinct d"]
    number: Int[Any, " points"]  # which of these each point handed in is
    sides: list[np.ndarray]  # v0, v1, u0, u1


def cloud_of(points: Float[Any, "points d"], boundary: Boundary) -> Cloud:
    """The cloud in the boundary's frame of size one.

    Points are sorted by their distance from the boundary's centre of gravity, then by coordinates:
    no sum depends on the order they came in, and every so-many-th of them is an even choice.
    """
    sides = [np.asarray(x, float) for x in (boundary.v0, boundary.v1, boundary.u0, boundary.u1)]
    given = np.asarray(points, float)
    centre, size = centre_and_size(sides)
    distinct, number = np.unique((given - centre) / size, axis=0, return_inverse=True)
    order = np.argsort(np.linalg.norm(distinct, axis=1), kind="stable")
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    lines = [(x - centre) / size for x in sides]
    return Cloud(distinct[order], place[number.reshape(-1)], lines)


def thinned(points: Float[Any, "points d"], most: int) -> Float[Any, "kept d"]:
    """At most `most` of the points, evenly by their order."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(int)]
