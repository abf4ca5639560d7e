"""The base surface: boundary polylines to curves, curves to a Coons patch (paper section 2.3)."""

import operator

import numpy as np
from jax.typing import ArrayLike

from jaxfit._base._boundary import Boundary, diagonal, middle
from jaxfit._base._coons import GREVILLE, AbstractAbscissae, coons_net
from jaxfit._base._curve_fit import CurveStart, fit_curves
from jaxfit._base._opposite import starts_by_count, starts_by_tolerance
from jaxfit._checks import as_points, is_concrete
from jaxfit._splines import BSplineSurface

MAX_STEPS = 100  # of the curve fit; few curves use them up
CLOSE = 0.01  # the curve fit stops when its average error is this much of the tolerance
FLAT = 0.2  # with a given net, pieces this straight (times the tolerance) are split in the middle


def base_surface(
    boundary: Boundary,
    points: ArrayLike | None = None,
    net: tuple[int, int] | None = None,
    order: tuple[int, int] = (4, 4),
    tolerance: float = 5e-3,
    abscissae: AbstractAbscissae = GREVILLE,
) -> BSplineSurface:
    """A surface that has the four boundary polylines as its sides: where a fit starts.

    Each polyline is reduced to its Douglas-Peucker vertices, which are the first control points
    of a B-spline curve; geometric approximation fits the curve to the polyline; opposite curves
    are brought onto common knots; a bilinear Coons blend of the control points fills the inside
    (`coons_surface`). The domain is [0, 1] x [0, 1]; the corners are those of the boundary.

    Parameters
    ----------
    boundary : Boundary
        Four polylines in d dimensions, any unit, any number of vertices.
    points : array (N, d), optional
        The cloud. The Coons surface does not look inside: the cloud serves only to measure
        the bounding-box diagonal, of which `tolerance` is a fraction.
    net : (nu, nv), optional
        Control points along u and v, exactly. Without it each curve takes as many as `tolerance`
        asks for (at least its order, at most 64), and the net is the refinement of opposite
        curves to their common knots, which does not change their shape. Knots of opposite
        curves closer than 0.02 of the domain and half a mean span are made equal before the fit.
    order : (K, L)
        Degree + 1 along u and v, each 2 to 8.
    tolerance : float
        How far from the reduced polyline, as a fraction of the diagonal, Douglas-Peucker may
        leave a vertex (default 5e-3). The fitted curves are closer on average (0.02 to 0.2 % of
        the diagonal on scans); a rough outline may be rounded off by twice the tolerance. With
        `net` all vertices are spread by deviation and length, and `tolerance` matters little:
        pieces straight to within a fifth of it are split in the middle.
    abscissae : Greville() or Uniform()
        Of the Coons blend; see `coons_surface`.

    Raises
    ------
    ValueError
        For a net smaller than the order, an order outside 2 to 8, a tolerance that is not
        positive, points of another dimension.
    TypeError
        For a boundary traced by `jit`: which vertices are kept depends on their values.

    Notes
    -----
    Vertices are chosen by value, so this runs outside `jit` and has no derivative; the blend
    alone, `coons_surface`, has. The boundary says nothing about the inside: where that bulges or
    folds over, only the fit can find it. The work is one compiled call for all four curves
    (two if K and L differ), padded so that boundaries of similar size share it.

    Sources: paper sections 2.3 and 4.1, equations (5)-(7), Algorithm 1 for curves.
    """
    order, net = _checked(boundary, net, order, tolerance)
    sides = [np.asarray(x) for x in (boundary.v0, boundary.v1, boundary.u0, boundary.u1)]
    dtype, dimension = sides[0].dtype, sides[0].shape[1]
    cloud = [] if points is None else [np.asarray(as_points("points", points, dimension))]
    # Centred and of size one, so that neither units nor coordinates in the millions matter.
    centre, size = middle(*sides), diagonal(*sides)
    lines = [(x.astype(float) - centre) / size for x in sides]
    curves = _curves(lines, net, order, tolerance * diagonal(*sides, *cloud) / size, dtype)
    controls, knots = zip(*curves, strict=True)
    blend = coons_net(controls, knots[0], knots[2], abscissae)
    placed = (np.asarray(blend, float) * size + centre).astype(dtype)
    for j, side in ((0, sides[0]), (-1, sides[1])):  # the corners to the last bit
        placed[0, j], placed[-1, j] = side[0], side[-1]
    return BSplineSurface(placed, knots[0], knots[2])


def _curves(
    lines: list[np.ndarray],
    net: tuple[int, int] | None,
    order: tuple[int, int],
    tolerance: float,
    dtype: np.dtype,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Control points and knots of v0, v1, u0, u1; opposite ones have equal knots."""
    starts: list[CurveStart] = []
    for k, pair in enumerate(((lines[0], lines[1]), (lines[2], lines[3]))):
        if net is None:
            starts += starts_by_tolerance(pair, order[k], tolerance)
        else:
            starts += starts_by_count(pair, order[k], net[k], FLAT * tolerance)
    close = CLOSE * tolerance
    if order[0] == order[1]:  # all four in one compiled call
        return fit_curves(starts, order[0], close, MAX_STEPS, dtype)
    return [
        curve
        for k, pair in enumerate((starts[:2], starts[2:]))
        for curve in fit_curves(pair, order[k], close, MAX_STEPS, dtype)
    ]


def _checked(
    boundary: Boundary,
    net: tuple[int, int] | None,
    order: tuple[int, int],
    tolerance: float,
) -> tuple[tuple[int, int], tuple[int, int] | None]:
    if not isinstance(boundary, Boundary):
        raise TypeError(
            f"boundary must be a Boundary, but is a {type(boundary).__name__}; build one with "
            "Boundary(v0, v1, u0, u1) or Boundary.from_grid(grid)."
        )
    if not is_concrete(boundary):
        raise TypeError("boundary must be concrete, but is traced; call base_surface outside jit.")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, but is {tolerance}; use for instance 5e-3.")
    order = _pair("order", order)
    if not all(2 <= each <= 8 for each in order):
        raise ValueError(f"order must be 2 to 8 in each direction, but is {order}; change it.")
    if net is None:
        return order, None
    net = _pair("net", net)
    if net[0] < order[0] or net[1] < order[1]:
        raise ValueError(
            f"net must be at least {order[0]} x {order[1]} control points for order {order}, but "
            f"is {net[0]} x {net[1]}; enlarge it or lower the order."
        )
    return order, net


def _pair(name: str, values: tuple[int, int]) -> tuple[int, int]:
    try:
        first, second = (operator.index(x) for x in values)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} must be two whole numbers, but is {values!r}; give one for u and one for v."
        ) from error
    return first, second
