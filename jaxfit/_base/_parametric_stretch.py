"""How evenly a parametrisation spreads points, and the weights that make it more even."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._delaunay_stars import WIDEST, Stars, cyclic_neighbours

LONGEST = 4.0  # times the median length in the domain per length in space; longer links count less
STEEPEST = 5.0  # times the median: the most that a stretch counts in one reweighting


def area_stretch(
    star: Stars, points: Float[Any, "points d"], places: Float[Any, "points 2"], fixed: int
) -> tuple[Float[Any, " points"], float]:
    r"""Stretch around each free point, as multiples of the median, and its spread.

    The stretch is $\sigma = \sqrt{A / A_{uv}}$ with the areas of the star in space and in the domain; its
    spread is the standard deviation of $\log \sigma$. Areas of whole stars rather than the stretch of
    each triangle (Sander et al. 2001): a single triangle turned over, as stars that do not quite agree
    contain, would outweigh all others. The first `fixed` points and those without area have 1.
    """
    after = cyclic_neighbours(star.members, star.filled)[1]
    inside = star.filled & (star.angle < WIDEST)
    steps, sides = points[star.members] - points[:, None], points[after] - points[:, None]
    square = np.sum(steps**2, axis=2) * np.sum(sides**2, axis=2) - np.sum(steps * sides, axis=2) ** 2
    area = np.sum(np.where(inside, np.sqrt(np.maximum(square, 0.0)), 0.0), axis=1)
    a, b = places[star.members] - places[:, None], places[after] - places[:, None]
    signed = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    shadow = np.abs(np.sum(np.where(inside, signed, 0.0), axis=1))
    counts = (area > 0) & (shadow > 0) & (np.arange(len(points)) >= fixed)
    if not counts.any():
        return np.ones(len(points)), 0.0
    stretch = np.sqrt(area[counts] / shadow[counts])
    stretch = stretch / np.median(stretch)
    whole = np.ones(len(points))
    whole[counts] = np.clip(stretch, 1 / STEEPEST, STEEPEST)
    return whole, float(np.std(np.log(stretch)))


def link_weights(
    star: Stars, points: Float[Any, "points d"], places: Float[Any, "points 2"]
) -> Float[Any, "points width"]:
    """Less than 1 for neighbours that lie far apart in the domain for their distance in space.

    Links from one sheet to another that comes near are few and long; those within a sheet are many. With
    weights that fall as the square of the length, so that a longer link pulls less, the many win. Where most
    have no length, for all points went to one place, there is no telling.
    """
    far = np.linalg.norm(points[star.members] - points[:, None], axis=2)
    ratio = np.linalg.norm(places[star.members] - places[:, None], axis=2)
    ratio = ratio / np.where(star.filled, far, 1.0)
    most = LONGEST * float(np.median(ratio[star.filled]))
    far_apart = star.filled & (ratio > most) & (most > 0)
    return np.where(far_apart, (most / np.where(ratio > 0, ratio, 1.0)) ** 2, 1.0)
