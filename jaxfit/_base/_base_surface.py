"""The base surface: boundary polylines to curves, curves to a Coons patch (paper section 2.3)."""

import numpy as np
from jax.typing import ArrayLike

from jaxfit._base._base_method import AbstractBaseMethod, Coons
from jaxfit._base._boundary import Boundary, centre_and_size, check_concrete, checked_boundary, farthest
from jaxfit._base._coons import GREVILLE, AbstractAbscissae, coons_net
from jaxfit._base._curve_fit import CurveStart, fit_curves
from jaxfit._base._default_net import checked_net_shape, default_net
from jaxfit._base._host_splines import halve_widest_spans
from jaxfit._base._normalised_cloud import cloud_of
from jaxfit._base._opposite_curves import starts_by_count, starts_by_tolerance
from jaxfit._base._same_place import check_same_place
from jaxfit._checks import (
    as_points,
    check_kind,
    check_number,
    checked_order,
    eager_where_concrete,
    is_concrete,
)
from jaxfit._progress_line import shows_progress
from jaxfit._splines import BSplineSurface

MAX_STEPS = 100  # of the curve fit; few curves use them up
CLOSE = 0.01  # the curve fit stops when its average error is this much of the tolerance
FLAT = 0.2  # with a given net, pieces this straight (times the tolerance) are split in the middle


@shows_progress("making a base surface")
@eager_where_concrete
def base_surface(
    boundary: Boundary,
    points: ArrayLike | None = None,
    net: tuple[int, int] | None = None,
    order: int | tuple[int, int] = (4, 4),
    tolerance: float = 5e-3,
    abscissae: AbstractAbscissae = GREVILLE,
    method: Coons | AbstractBaseMethod | None = None,
) -> BSplineSurface:
    """A surface that has the four boundary polylines as its sides: where a fit starts.

    Each polyline is reduced to its Douglas-Peucker vertices, which are the first control points
    of a B-spline curve; geometric approximation fits the curve to the polyline; opposite curves
    are brought onto common knots; a bilinear Coons blend of the control points fills the inside
    (`coons_surface`). The domain is [0, 1] x [0, 1]; the corners are those of the boundary. With
    `method`, the control points inside then move to where the cloud is.

    Parameters
    ----------
    boundary : Boundary
        Four polylines in d dimensions, any unit, any number of vertices.
    points : array (N, d), optional
        The cloud. The Coons surface uses it only to measure the size of which `tolerance` is a fraction.
        The other methods need it.
    net : (nu, nv), optional
        Control points along u and v, exactly. Without it each curve takes as many as `tolerance`
        asks for (at least its order, at most 64), and the net is the refinement of opposite
        curves to their common knots, which does not change their shape. Knots of opposite
        curves closer than 0.02 of the domain and half a mean span are made equal before the fit.
        Methods that use the cloud then refine it, where it is smaller, to about one control
        point for every eight points, at most 64 each way.
    order : (K, L) or int
        Degree + 1 along u and v, each 2 to 8; one number is that of both.
    tolerance : float
        How far from the reduced polyline Douglas-Peucker may leave a vertex, as a fraction of the size
        (default 5e-3): twice the greatest distance of any point from the boundary's centre of gravity,
        which is the diagonal of a rectangle. The fitted curves are closer on average (0.02 to 0.2 % of
        the diagonal on scans); a rough outline may be rounded off by twice the tolerance. With
        `net` all vertices are spread by deviation and length, and `tolerance` matters little:
        pieces straight to within a fifth of it are split in the middle.
    abscissae : Greville() or Uniform()
        Of the Coons blend; see `coons_surface`.
    method : Coons(), Meshless() or DynamicBaseSurface(), optional
        What fills the inside (default `Coons(abscissae)`, right where the patch is close to its
        boundary's blend). `Meshless()` is the surest for patches that bulge or overhang.

    Raises
    ------
    ValueError
        For a net smaller than the order, an order outside 2 to 8, a tolerance that is not
        positive, points of another dimension, a cloud far from its boundary or a hundred times as large or
        small; a method that needs points without them.
    TypeError
        For a boundary traced by `jit`: which vertices are kept depends on their values.

    Notes
    -----
    Vertices are chosen by value, so this runs outside `jit` and has no derivative; the blend
    alone, `coons_surface`, has. The boundary says nothing about the inside: where that bulges or
    folds over, only the fit can find it. The work is one compiled call for all four curves
    (two if K and L differ), padded so that boundaries of similar size share it.

    Sources: paper sections 2.3 and 4.1, equations (5)-(7), Algorithm 1 for curves.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5), indexing="ij")
    >>> surface = jf.base_surface(jf.Boundary.from_grid(np.stack([x, y, x * y], axis=2)), net=(4, 4))
    >>> surface.shape, surface.order, surface(1.0, 1.0).tolist()
    ((4, 4), (4, 4), [1.0, 1.0, 1.0])
    """
    boundary = checked_boundary(boundary, points)
    order = checked_order(order)
    net = _checked_net(boundary, net, order, tolerance)
    check_kind("abscissae", abscissae, AbstractAbscissae, "Greville()")
    check_kind("method", method, (Coons, AbstractBaseMethod, type(None)), "Coons() or Meshless()")
    sides = [np.asarray(x) for x in (boundary.v0, boundary.v1, boundary.u0, boundary.u1)]
    dtype, dimension = sides[0].dtype, sides[0].shape[1]
    _check_cloud(method, points, dimension)
    clouds = [] if points is None else [np.asarray(as_points("points", points, dimension))]
    for each in clouds:
        check_same_place(each, boundary)
    # Centred and of size one, so that neither units nor coordinates in the millions matter.
    centre, size = centre_and_size(sides)
    lines = [(x.astype(float) - centre) / size for x in sides]
    reach = 2 * farthest(centre, *sides, *clouds)
    curves = _curves(lines, net, order, tolerance * reach / size, dtype)
    controls, knots = zip(*curves, strict=True)
    blend = coons_net(
        controls, knots[0], knots[2], method.abscissae if isinstance(method, Coons) else abscissae
    )
    placed, pair = np.asarray(blend, float), (knots[0].astype(float), knots[2].astype(float))
    if isinstance(method, AbstractBaseMethod):
        cloud = cloud_of(clouds[0], boundary)
        if net is None:
            placed, pair = halve_widest_spans(
                placed, pair, order, default_net(len(cloud.points), boundary, order)
            )
        placed = method.fill(placed, pair, order, cloud)
    placed = (placed * size + centre).astype(dtype)
    for j, side in ((0, sides[0]), (-1, sides[1])):  # the corners to the last bit
        placed[0, j], placed[-1, j] = side[0], side[-1]
    return BSplineSurface(placed, *(x.astype(dtype) for x in pair))


def _check_cloud(method: Coons | AbstractBaseMethod | None, points: ArrayLike | None, dimension: int) -> None:
    if not is_concrete(points):
        raise TypeError(
            "points must be concrete, but are traced; call base_surface outside jit. What may be traced and "
            "differentiated are coons_surface and approximate(points, base)."
        )
    if not isinstance(method, AbstractBaseMethod):
        return
    if points is None:
        raise ValueError(
            f"points must be given for {type(method).__name__}(), but is None; pass the cloud or use Coons()."
        )
    method.check_dimension(dimension)


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


def _checked_net(
    boundary: Boundary,
    net: tuple[int, int] | None,
    order: tuple[int, int],
    tolerance: float,
) -> tuple[int, int] | None:
    check_concrete(boundary)
    check_number("tolerance", tolerance, 0.0)
    if not tolerance > 0:
        raise ValueError(f"tolerance must be positive, but is {tolerance}; use for instance 5e-3.")
    return None if net is None else checked_net_shape(net, order)
