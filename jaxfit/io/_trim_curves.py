"""Loops as few curves in (u, v): cubic splines through their vertices where these follow the polyline."""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit._trimmed._checked_loops import Loop, check_simple, signed_area

_CORNER = np.deg2rad(25.0)  # greater turns are corners
_RATIO = 3.0  # of the lengths of two neighbouring edges, beyond which a curve ends between them
_LEAST_EDGES = 8  # that make a curve
_AREA = 2e-5  # between all curves and the polylines, as a share of the region
_SAG = 0.05  # of an edge: how far the curve may be from it
_SAMPLES = 8  # on each edge


class TrimCurve(NamedTuple):
    """A spline from its first to its last knot; a line is one of degree 1 with two control points."""

    control_points: Float[np.ndarray, "n 2"]
    knots: Float[np.ndarray, " knots"]
    degree: int


def lines(loop: Loop) -> list[TrimCurve]:
    """Every edge of its own."""
    return [_line(start, end) for start, end in zip(loop, np.roll(loop, -1, axis=0), strict=True)]


def trim_curves(loops: list[Loop], domain: Float[np.ndarray, "2 2"]) -> list[list[TrimCurve]]:
    """The curves of each loop, end to end.

    A run of vertices without corners becomes one cubic spline, if that stays in the domain and near the
    edges; all other edges stay lines. If the curves of loops would touch, all edges stay lines.
    """
    budget = _AREA * abs(sum(map(signed_area, loops))) / sum(map(len, loops))  # for each edge
    found, outlines = [], []
    for loop in loops:
        curves, outline = _of_loop(loop, domain, budget)
        found.append(curves)
        outlines.append(outline)
    try:
        check_simple(outlines)
    except ValueError:
        return [lines(loop) for loop in loops]
    return found


def _of_loop(loop: Loop, domain: np.ndarray, budget: float) -> tuple[list[TrimCurve], Loop]:
    """The curves of a loop, and the polyline of samples on them."""
    edges = np.roll(loop, -1, axis=0) - loop
    lengths = np.linalg.norm(edges, axis=1)
    turns = np.angle(np.exp(1j * np.diff(np.arctan2(*edges.T[::-1]), prepend=np.arctan2(*edges[-1][::-1]))))
    ratios = lengths / np.roll(lengths, 1)
    corners = np.flatnonzero((abs(turns) > _CORNER) | (np.maximum(ratios, 1 / ratios) > _RATIO))
    closed = not len(corners)
    corners = np.array([0, len(loop) // 2]) if closed else corners
    curves: list[TrimCurve] = []
    outline = []
    for first, last in zip(corners, np.append(corners[1:], corners[0] + len(loop)), strict=True):
        run = loop[np.arange(first, last + 1) % len(loop)]
        tangents = _tangents(loop, [first, last]) if closed else None
        curve, samples = _of_run(run, tangents, domain, budget)
        outline.append(samples)
        curves += [curve] if curve else [_line(a, b) for a, b in pairwise(run)]
    return curves, np.concatenate(outline)


def _of_run(
    run: Loop, tangents: list[np.ndarray] | None, domain: np.ndarray, budget: float
) -> tuple[TrimCurve | None, Loop]:
    """The cubic spline through a run of vertices, None where it will not do; samples without the last."""
    from scipy.interpolate import make_interp_spline

    if len(run) <= _LEAST_EDGES:
        return None, run[:-1]
    at = _along(run)
    ends = None if tangents is None else tuple([(1, tangent)] for tangent in tangents)
    spline = make_interp_spline(at, run, k=3, bc_type=ends)
    shares = np.arange(_SAMPLES) / _SAMPLES
    samples = spline(at[:-1, None] + shares * np.diff(at)[:, None])
    edges = np.diff(run, axis=0)
    gaps = samples - run[:-1, None] - shares[:, None] * edges[:, None]
    sags = np.linalg.norm(gaps, axis=2).max(axis=1) / np.linalg.norm(edges, axis=1)
    outline = samples.reshape(-1, 2)
    between = signed_area(np.concatenate([outline, run[-1:], run[-2:0:-1]]))
    inside = ((spline.c >= domain[:, 0] - 1e-12) & (spline.c <= domain[:, 1] + 1e-12)).all()
    if not inside or sags.max() > _SAG or abs(between) > budget * len(edges):
        return None, run[:-1]
    return TrimCurve(np.clip(spline.c, *domain.T), spline.t, 3), outline


def _tangents(loop: Loop, at: list[Any]) -> list[Float[np.ndarray, "2"]]:
    """Of the closed cubic spline through a loop, at some of its vertices."""
    from scipy.interpolate import CubicSpline

    closed = np.concatenate([loop, loop[:1]])
    along = _along(closed)
    return [CubicSpline(along, closed, bc_type="periodic")(along[i], 1) for i in at]


def _along(points: Loop) -> Float[np.ndarray, " k"]:
    """Chord lengths from the first point."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def _line(start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> TrimCurve:
    length = float(np.linalg.norm(end - start))
    return TrimCurve(np.stack([start, end]), np.array([0.0, 0.0, length, length]), 1)
