"""One referee for every fit: true distances and folds, by NumPy and SciPy alone.

It takes control points and knots, whoever made them, so that peers are judged as this library is.
"""

import numpy as np
from scipy.interpolate import BSpline, NdBSpline
from scipy.spatial import KDTree

SAMPLES = 6  # in each knot span and direction
STEPS = 12


def judged(net, knots, points):
    """Average and maximum distance of points (N, 3) in % of their diagonal, and folds, as cells."""
    points = np.asarray(points, float).reshape(-1, 3)
    away = distances(net, knots, points)
    size = 100 / np.linalg.norm(np.ptp(points, axis=0))
    return {"average %": size * away.mean(), "maximum %": size * away.max(), "folds": folds(net, knots)}


def judged_surface(surface, points):
    """The same of a surface of jaxfit."""
    return judged(surface.control_points, (surface.knots_u, surface.knots_v), points)


def distances(net, knots, points):
    """Distance of each point from the surface: the nearest of many samples, then Gauss-Newton from there."""
    net, knots, degrees = _arrays(net, knots)
    axes = [_sampled(k, p) for k, p in zip(knots, degrees, strict=True)]
    samples = _on_grid(net, knots, degrees, axes)
    nearest, index = KDTree(samples.reshape(-1, 3)).query(points, workers=-1)
    foot = np.stack([a[i] for a, i in zip(axes, np.unravel_index(index, samples.shape[:2]), strict=True)], 1)
    surface = NdBSpline(knots, net, degrees)
    low, high = np.array([[k[p], k[-p - 1]] for k, p in zip(knots, degrees, strict=True)]).T
    for _ in range(STEPS):
        residual = points - surface(foot)
        nearest = np.minimum(nearest, np.linalg.norm(residual, axis=1))
        along = [surface(foot, nu=nu) for nu in ((1, 0), (0, 1))]
        step = _step(*along, residual, foot <= low, foot >= high)
        foot = np.clip(foot + step, low, high)
    return np.minimum(nearest, np.linalg.norm(points - surface(foot), axis=1))


def folds(net, knots, count=200):
    """Neighbours among count x count samples whose normals are more than 90 degrees apart."""
    net, knots, degrees = _arrays(net, knots)
    axes = [np.linspace(k[p], k[-p - 1], count) for k, p in zip(knots, degrees, strict=True)]
    normal = np.cross(*(_on_grid(net, knots, degrees, axes, nu) for nu in ((1, 0), (0, 1))))
    pairs = (normal[1:], normal[:-1]), (normal[:, 1:], normal[:, :-1])
    return sum(int(np.sum(np.sum(a * b, axis=2) < 0)) for a, b in pairs)


def _arrays(net, knots):
    net, knots = np.asarray(net, float), tuple(np.asarray(k, float) for k in knots)
    return net, knots, tuple(len(k) - n - 1 for k, n in zip(knots, net.shape[:2], strict=True))


def _sampled(knots, degree):
    breaks = np.unique(knots[degree : len(knots) - degree])
    inner = breaks[:-1, None] + np.diff(breaks)[:, None] * np.arange(SAMPLES) / SAMPLES
    return np.append(inner.ravel(), breaks[-1])


def _on_grid(net, knots, degrees, axes, nu=(0, 0)):
    for k, degree, at, order in zip(knots, degrees, axes, nu, strict=True):
        net = np.swapaxes(BSpline(k, net, degree)(at, order), 0, 1)
    return net


def _step(along_u, along_v, residual, at_low, at_high):
    """A Gauss-Newton step; a parameter that would leave the domain stays."""
    a, b, c = (np.sum(x * y, axis=1) for x, y in ((along_u,) * 2, (along_u, along_v), (along_v,) * 2))
    downhill = np.stack([np.sum(x * residual, axis=1) for x in (along_u, along_v)], axis=1)
    held = (at_low & (downhill < 0)) | (at_high & (downhill > 0))
    p, q = np.where(held, 0.0, downhill).T
    b = np.where(held.any(axis=1), 0.0, b)
    det = np.maximum(a * c - b * b, 1e-14 * a * c + 1e-300)
    return np.stack([(c * p - b * q) / det, (a * q - b * p) / det], axis=1)
