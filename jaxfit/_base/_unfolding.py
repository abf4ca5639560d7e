"""Points that make a surface fold lose weight, until the surface smoothed between the others has no folds."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxfit._base._host_splines import GridEvaluator, Knots
from jaxfit._base._thin_plate_fit import ThinPlateFit

LEAST_COSINE = 0.3  # cosine of the angle between neighbouring normals from which on they count as a fold
LEAST_COSINE_CREASED = -0.8  # the same for order 2, whose surfaces may have sharp edges at all knots
SAMPLES = 200  # at least so many in all along u and along v,
SAMPLES_A_CELL = 4  # and in every cell
WEIGHT_FACTOR = 0.1  # what is left of the weight of a point near a fold, each time
ROUNDS = 8  # at most
MOST_IDLE_ROUNDS = 3  # rounds in a row without fewer folds before the end


def unfolded(
    fit: ThinPlateFit, net: Float[Any, "nu nv 3"], weights: Float[Any, " points"], smoothing: float
) -> Float[Any, "nu nv 3"]:
    """The net with the fewest folds when points in folded cells and around them lose weight, round by round.

    A fold is where parameters and positions contradict each other: sheets that have grown together, a pocket
    under the sheet, noise coarser than the points are dense. No one sheet passes through all the
    points there, so the thin plate closes the surface over those that lost. Cells that are still folded
    take ever more of their surroundings with them. Folds that the border has are left.
    """
    breaks = [np.unique(t) for t in fit.knots]
    inside = [
        np.clip(np.searchsorted(x, places, side="right") - 1, 0, len(x) - 2)
        for x, places in zip(breaks, fit.places.T, strict=True)
    ]
    reach = np.zeros([len(x) - 1 for x in breaks], int)
    cells, count = folded_cells(net, fit.knots, fit.order)
    best, fewest, idle = net, count, 0
    for _ in range(ROUNDS):
        if count == 0 or idle == MOST_IDLE_ROUNDS:
            break
        reach += cells
        near = _surroundings(np.where(cells, reach, 0))
        weights = np.where(near[inside[0], inside[1]], WEIGHT_FACTOR * weights, weights)
        net = fit.net(weights, smoothing)
        cells, count = folded_cells(net, fit.knots, fit.order)
        idle = 0 if count < fewest else idle + 1
        if count < fewest:
            best, fewest = net, count
    return best


def folded_cells(
    net: Float[Any, "nu nv 3"], knots: Knots, order: tuple[int, int]
) -> tuple[Bool[Any, "cells_u cells_v"], int]:
    """The cells where the normal turns too far between neighbouring samples, and how many pairs there are."""
    breaks = [np.unique(t) for t in knots]
    samples, cell = zip(*(_samples(x) for x in breaks), strict=True)
    normals = GridEvaluator(knots, order, *samples).normals(net)
    cells = np.zeros([len(x) - 1 for x in breaks], bool)
    turn_u, turn_v = (LEAST_COSINE_CREASED if k == 2 else LEAST_COSINE for k in order)
    along_u = np.argwhere(np.sum(normals[1:] * normals[:-1], axis=2) < turn_u)
    along_v = np.argwhere(np.sum(normals[:, 1:] * normals[:, :-1], axis=2) < turn_v)
    for pairs, step in ((along_u, (1, 0)), (along_v, (0, 1))):
        for i, j in (pairs.T, (pairs + step).T):
            cells[cell[0][i], cell[1][j]] = True
    return cells, len(along_u) + len(along_v)


def _samples(breaks: Float[Any, " breaks"]) -> tuple[np.ndarray, np.ndarray]:
    """Parameters from end to end, equally many in every span, and the numbers of their spans."""
    spans = len(breaks) - 1
    each = max(SAMPLES_A_CELL, -(-SAMPLES // spans))
    share = np.arange(each) / each
    inner = (breaks[:-1, None] + np.diff(breaks)[:, None] * share).ravel()
    return np.append(inner, breaks[-1]), np.append(np.repeat(np.arange(spans), each), spans - 1)


def _surroundings(reach: np.ndarray) -> Bool[Any, "cells_u cells_v"]:
    """All cells at most as far from a cell as its reach says, in cells."""
    from scipy.ndimage import binary_dilation

    near = np.zeros(reach.shape, bool)
    for far in range(1, int(reach.max()) + 1):
        near |= binary_dilation(reach >= far, np.ones((2 * far + 1, 2 * far + 1)))
    return near
