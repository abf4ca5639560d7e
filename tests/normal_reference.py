"""Dense matrices of least-squares fits by SciPy, as oracles."""

import numpy as np
from scipy.interpolate import BSpline


def basis(knots, count, x, derivative=0):
    """Matrix of all basis functions at `x`; the right end belongs to the last span."""
    knots = np.asarray(knots, float)
    degree = len(knots) - count - 1
    low, high = knots[degree], knots[count]
    x = np.clip(np.asarray(x, float), low, np.nextafter(high, low))
    columns = []
    for row in np.eye(count):
        spline = BSpline(knots, row, degree)
        columns.append(spline(x, derivative) if derivative <= degree else np.zeros_like(x))
    return np.stack(columns, axis=1)


def design(surface, u, v):
    """Dense matrix (points, nu nv) of a surface's basis functions."""
    nu, nv = surface.shape
    a = basis(surface.knots_u, nu, u)[:, :, None] * basis(surface.knots_v, nv, v)[:, None]
    return a.reshape(len(a), nu * nv)


def thin_plate_matrix(surface):
    """Equation (10) on [0, 1]^2, by Gauss's rule with more points than it takes."""
    total = 0
    one = [squares(*x) for x in zip((surface.knots_u, surface.knots_v), surface.shape, strict=True)]
    for d, factor in ((2, 1), (1, 2), (0, 1)):
        total = total + factor * np.kron(one[0][d], one[1][2 - d])
    return total


def squares(knots, count):
    """Integrals of products of derivatives of order 0, 1, 2, the domain being scaled to [0, 1]."""
    knots = np.asarray(knots, float)
    degree = len(knots) - count - 1
    low, high = knots[degree], knots[count]
    breaks = np.unique(knots[degree : count + 1])
    nodes, weights = np.polynomial.legendre.leggauss(degree + 3)
    centre, half = 0.5 * (breaks[1:] + breaks[:-1]), 0.5 * np.diff(breaks)
    x = (centre[:, None] + half[:, None] * nodes).ravel()
    w = (half[:, None] * weights).ravel() / (high - low)
    rows = [basis(knots, count, x, d) * (high - low) ** d for d in range(3)]
    return [row.T @ (w[:, None] * row) for row in rows]
