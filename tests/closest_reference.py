"""Closest distances by brute force: dense samples, and a search without derivatives from each valley.

Slow and simple, and shares nothing with what it checks: the surface is evaluated by SciPy.
"""

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import NdBSpline
from scipy.spatial import KDTree

from jaxfit._splines import BSplineSurface

STENCIL = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])


def ruled(curve):
    """A curve as a surface that does not change along v, so that one reference serves both."""
    net = jnp.stack([curve.control_points] * 2, axis=1)
    return BSplineSurface(net, curve.knots, np.array([0.0, 0.0, 1.0, 1.0]))


def sample_parameters(knots, per_cell):
    """`per_cell` parameters in every non-empty span, knots and ends included."""
    knots = np.unique(np.asarray(knots, float))
    inner = knots[:-1, None] + np.diff(knots)[:, None] * np.arange(per_cell) / per_cell
    return np.append(inner.reshape(-1), knots[-1])


def _by_scipy(surface):
    """The surface as a function of parameters (..., 2)."""
    knots = tuple(np.asarray(x, float) for x in (surface.knots_u, surface.knots_v))
    degrees = tuple(order - 1 for order in surface.order)
    return NdBSpline(knots, np.asarray(surface.control_points, float), degrees)


def nearest_distance(surface, points, per_cell=12, neighbours=64):
    """Distance of every point to the nearest point of the surface, to about 1e-11 of its size."""
    (low_u, high_u), (low_v, high_v) = np.asarray(surface.domain)
    ends = np.array([[low_u, low_v], [high_u, high_v]])
    axes = [sample_parameters(k, per_cell) for k in (surface.knots_u, surface.knots_v)]
    axes = [x[(x >= a) & (x <= b)] for x, a, b in zip(axes, *ends, strict=True)]
    evaluate = _by_scipy(surface)
    samples = evaluate(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    who, index = _valleys(samples, points, neighbours)
    a, b = np.unravel_index(index, samples.shape[:2])
    foot = np.stack([axes[0][a], axes[1][b]], axis=1)
    gap = np.stack([np.gradient(x)[i] for x, i in zip(axes, (a, b), strict=True)], axis=1)
    found = _descend(evaluate, points[who], foot, gap, ends)
    nearest = np.full(len(points), np.inf)
    np.minimum.at(nearest, who, found)
    return nearest


def _valleys(samples, points, neighbours):
    """Pairs (point, sample) where none of the eight samples around is nearer to the point."""
    flat = samples.reshape(-1, samples.shape[-1])
    wall = np.pad(samples, ((1, 1), (1, 1), (0, 0)), constant_values=np.inf)
    distance, index = KDTree(flat).query(points, k=min(neighbours, len(flat)), workers=-1)
    who = np.repeat(np.arange(len(points)), index.shape[1])
    index, distance = index.reshape(-1), distance.reshape(-1)
    a, b = np.unravel_index(index, samples.shape[:2])
    lowest = np.ones(len(who), bool)
    for i, j in STENCIL:
        beside = np.linalg.norm(wall[a + 1 + i, b + 1 + j] - points[who], axis=1)
        lowest &= distance <= beside
    return who[lowest], index[lowest]


def _descend(evaluate, points, foot, gap, ends, steps=400):
    """Go to the best of eight neighbours at `gap`, or halve the gap where none is better."""
    best = np.linalg.norm(evaluate(foot) - points, axis=-1)
    gap = np.broadcast_to(gap, foot.shape).copy()
    small = 1e-7 * (ends[1] - ends[0])
    active = np.arange(len(points))
    for _ in range(steps):
        tried = np.clip(foot[active, None] + gap[active, None] * STENCIL[None], *ends)
        away = np.linalg.norm(evaluate(tried) - points[active, None], axis=-1)
        choice = away.argmin(axis=1)
        rows = np.arange(len(active))
        better = away[rows, choice] < best[active]
        moved = active[better]
        foot[moved] = tried[rows, choice][better]
        best[moved] = away[rows, choice][better]
        gap[active[~better]] *= 0.5
        active = active[(gap[active] > small).any(axis=1)]
        if not active.size:
            break
    return best
