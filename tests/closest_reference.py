"""Closest distances by brute force: dense samples, and a search without derivatives from each valley.

Slow and simple, and shares nothing with what it checks but the evaluation of the surface.
"""

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from jaxfit._splines import BSplineSurface

CHUNK = 4096
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


def nearest_distance(surface, points, per_cell=12, neighbours=64):
    """Distance of every point to the nearest point of the surface, to about 1e-11 of its size."""
    (low_u, high_u), (low_v, high_v) = np.asarray(surface.domain)
    ends = np.array([[low_u, low_v], [high_u, high_v]])
    axes = [sample_parameters(k, per_cell) for k in (surface.knots_u, surface.knots_v)]
    axes = [x[(x >= a) & (x <= b)] for x, a, b in zip(axes, *ends, strict=True)]
    samples = np.asarray(surface.grid(*axes))
    who, index = _valleys(samples, points, neighbours)
    a, b = np.unravel_index(index, samples.shape[:2])
    foot = np.stack([axes[0][a], axes[1][b]], axis=1)
    gap = np.stack([np.gradient(x)[i] for x, i in zip(axes, (a, b), strict=True)], axis=1)
    found = _descend(surface, points[who], foot, gap, ends)
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


def _descend(surface, points, foot, gap, ends, steps=400):
    """Go to the best of eight neighbours at `gap`, or halve the gap where none is better."""
    best = _distance(surface, points, foot)
    gap = np.broadcast_to(gap, foot.shape).copy()
    small = 1e-7 * (ends[1] - ends[0])
    active = np.arange(len(points))
    for _ in range(steps):
        tried = np.clip(foot[active, None] + gap[active, None] * STENCIL[None], *ends)
        away = _distance(surface, points[active], tried)
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


def _distance(surface, points, uv):
    """|Q - R(u, v)| for `uv` (n, 2) or (n, k, 2), in chunks of one size (so: one compilation)."""
    shape = uv.shape[:-1]
    uv = uv.reshape(len(points), -1, 2)
    result = np.empty(uv.shape[:2])
    for start in range(0, len(points), CHUNK):
        part = uv[start : start + CHUNK]
        padded = np.pad(part, ((0, CHUNK - len(part)), (0, 0), (0, 0)), mode="edge")
        value = np.asarray(surface(padded[..., 0], padded[..., 1]))[: len(part)]
        away = value - points[start : start + CHUNK, None]
        result[start : start + CHUNK] = np.linalg.norm(away, axis=-1)
    return result.reshape(shape)
