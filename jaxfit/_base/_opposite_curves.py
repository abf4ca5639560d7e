"""Starts for two opposite boundary curves: vertices, parameters and matching knots."""

import numpy as np

from jaxfit._base._curve_fit import CurveStart
from jaxfit._base._douglas_peucker import chord_lengths, densify, simplify
from jaxfit._splines._knots import knots_by_averaging

MOST_VERTICES = 64  # of a boundary curve whose size follows from the tolerance
MOST_POINTS = 4000  # of a polyline that take part in the fit; longer ones are thinned evenly
PER_SPAN = 4  # a knot span with fewer points than this gets as many more from the polyline
SPREAD = 0.02  # how much a unit of length attracts vertices against a unit of deviation
SNAP = 0.02  # knots of opposite curves closer than this fraction of the domain become one


def starts_by_tolerance(
    pair: tuple[np.ndarray, np.ndarray], order: int, tolerance: float
) -> list[CurveStart]:
    """Each curve with as few control points as `tolerance` allows, on knots of its own.

    Interior knots of the curve with fewer of them move onto the other's where they are within
    `SNAP` and half a mean span: before the fit, so that no fitted shape is changed by it. The
    knots still missing are inserted after the fit, which changes no shape either.
    """
    lines = [densify(x, order) for x in pair]
    kept = [simplify(x, tolerance, least=order, most=max(order, MOST_VERTICES)) for x in lines]
    parameters = [_at(x, k) for x, k in zip(lines, kept, strict=True)]
    knots = [knots_by_averaging(t, order) for t in parameters]
    inner = [t[order:-order] for t in knots]
    few, many = (0, 1) if len(inner[0]) <= len(inner[1]) else (1, 0)
    inner[few][:] = _matched(inner[few], inner[many])
    missing = [np.setdiff1d(inner[1], inner[0]), np.setdiff1d(inner[0], inner[1])]
    return [_start(*x) for x in zip(lines, kept, parameters, knots, missing, strict=True)]


def starts_by_count(
    pair: tuple[np.ndarray, np.ndarray], order: int, count: int, flat: float
) -> list[CurveStart]:
    """Both curves with `count` control points, on common knots.

    Each polyline gives `count` vertices; the means of their chord-length parameters, in order,
    are the common parameters that the knots come from (5). Long pieces attract vertices as
    well as bent ones, and pieces straight to within `flat` are split in the middle.
    """
    lines = [densify(x, count) for x in pair]
    kept = [simplify(x, flat, least=count, most=count, spread=SPREAD) for x in lines]
    common = np.mean([_at(x, k) for x, k in zip(lines, kept, strict=True)], axis=0)
    knots = knots_by_averaging(common, order)
    return [_start(x, k, common, knots, knots[:0]) for x, k in zip(lines, kept, strict=True)]


def _at(line: np.ndarray, kept: np.ndarray) -> np.ndarray:
    arc = chord_lengths(line)
    return arc[kept] / arc[-1]


def _matched(knots: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """`knots` with each moved onto a target within reach: nearest pairs first, one to one."""
    reach = min(SNAP, 0.5 / (len(targets) + 1))
    moved = knots.copy()
    distances = np.abs(knots[:, None] - targets[None, :])
    free_knots, free_targets = np.ones(len(knots), bool), np.ones(len(targets), bool)
    for flat in np.argsort(distances, axis=None, kind="stable"):
        i, j = np.unravel_index(flat, distances.shape)
        if distances[i, j] > reach:
            break
        if free_knots[i] and free_targets[j]:
            moved[i] = targets[j]
            free_knots[i] = free_targets[j] = False
    return np.sort(moved)


def _start(
    line: np.ndarray,
    kept: np.ndarray,
    parameters: np.ndarray,
    knots: np.ndarray,
    new_knots: np.ndarray,
) -> CurveStart:
    arc = chord_lengths(line)
    # The kept vertices sit at `parameters`; everything between them follows linearly.
    feet = np.interp(arc, arc[kept], parameters)
    stride = -(-len(line) // MOST_POINTS)
    used = np.unique(np.append(np.arange(0, len(line), stride), len(line) - 1))
    extra = _missing(feet[used], knots)
    places = np.interp(extra, parameters, arc[kept])
    more = np.stack([np.interp(places, arc, x) for x in line.T], axis=1)
    return CurveStart(
        np.concatenate([line[used], more]),
        np.concatenate([feet[used], extra]),
        line[kept],
        knots,
        new_knots,
    )


def _missing(feet: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Parameters to add so that no knot span is left with fewer than PER_SPAN points."""
    breaks = np.unique(knots)
    counts, _ = np.histogram(feet, breaks)
    poor = np.flatnonzero(counts < PER_SPAN)
    within = (np.arange(PER_SPAN) + 0.5) / PER_SPAN
    return (breaks[poor, None] + within * np.diff(breaks)[poor, None]).ravel()
