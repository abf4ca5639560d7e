"""How many control points the sides of a boundary take to be seen at all."""

import numpy as np
from jaxtyping import Float

from jaxfit._base._boundary import Boundary, diagonal
from jaxfit._base._default_base import FAR
from jaxfit._base._douglas_peucker import chord_lengths, densify

STEP = 1.2  # from one number of control points to the next
LEAST_SAMPLES = 200  # of a side
SAMPLES = 6  # for each control point
# Noise is not followed: so many times the least error of samples that were held out is enough.
ENOUGH = 1.1


def net_of_sides(boundary: Boundary, order: tuple[int, int], most: int) -> tuple[int, int]:
    """The least control points along u and v, from twice the order to `most`, with which curves come within
    FAR of the sides on average.

    Fits that begin with fewer take the waves of the sides for others that are longer.
    """
    pairs = (boundary.v0, boundary.v1), (boundary.u0, boundary.u1)
    lines = [[np.asarray(line, float) for line in pair] for pair in pairs]
    size = diagonal(np.concatenate([line for pair in lines for line in pair]))
    nu, nv = (
        max(_control_points(line, k, most, FAR * size) for line in pair)
        for pair, k in zip(lines, order, strict=True)
    )
    return nu, nv


def _control_points(line: Float[np.ndarray, "n d"], order: int, most: int, goal: float) -> int:
    """The fewest for one side."""
    forward = np.concatenate([[True], np.any(np.diff(line, axis=0) != 0, axis=1)])
    samples = densify(line[forward], LEAST_SAMPLES)
    counts = [2 * order]
    while (count := int(np.ceil(STEP * counts[-1]))) <= min(most, len(samples) // SAMPLES):
        counts.append(count)
    distances = []
    for count in counts:
        distances.append(_held_out_distance(samples, order, count))
        if distances[-1] <= goal:
            return count
    return counts[int(np.argmax(np.array(distances) <= ENOUGH * min(distances)))]


def _held_out_distance(samples: Float[np.ndarray, "n d"], order: int, count: int) -> float:
    """Of every second sample, on average, from the least-squares curve of the others with `count` control
    points, at the lengths of arc.
    """
    from scipy.interpolate import make_lsq_spline

    arc = chord_lengths(samples)
    at = arc / arc[-1]
    kept = np.concatenate([at[:-1:2], at[-1:]])
    inner = np.quantile(kept, np.linspace(0, 1, count - order + 2)[1:-1])
    knots = np.concatenate([np.zeros(order), inner, np.ones(order)])
    curve = make_lsq_spline(kept, np.concatenate([samples[:-1:2], samples[-1:]]), knots, order - 1)
    return float(np.linalg.norm(curve(at[1:-1:2]) - samples[1:-1:2], axis=1).mean())
