"""A base surface with another net, from a surface that is fitted already."""

import numpy as np
from jaxtyping import Float

from jaxfit._base._base_surface import base_surface
from jaxfit._base._boundary import Boundary
from jaxfit._base._host_splines import GridEvaluator, Knots
from jaxfit._splines import BSplineSurface, greville_abscissae


def carried_base(
    surface: BSplineSurface, boundary: Boundary, net: tuple[int, int], order: tuple[int, int]
) -> BSplineSurface:
    """`surface` on the knots that the boundary curves have with `net`, with these curves as its sides.

    It is interpolated at the Greville abscissae; then the control points on the border are replaced. Those
    inside stay, for a coarse net may have missed the curves by much more than it missed the points.
    """
    sides = base_surface(boundary, net=net, order=order)
    knots = (np.asarray(sides.knots_u, float), np.asarray(sides.knots_v, float))
    carried = np.array(sides.control_points)
    carried[1:-1, 1:-1] = _interpolated(surface, knots, order)[1:-1, 1:-1]
    return BSplineSurface(carried, sides.knots_u, sides.knots_v)


def _interpolated(
    surface: BSplineSurface, knots: Knots, order: tuple[int, int]
) -> Float[np.ndarray, "nu nv d"]:
    """The net on these knots whose surface passes through `surface` at their Greville abscissae."""
    from scipy.interpolate import make_interp_spline

    old = (np.asarray(surface.knots_u, float), np.asarray(surface.knots_v, float))
    places = [np.asarray(greville_abscissae(t, k), float) for t, k in zip(knots, order, strict=True)]
    net = np.asarray(surface.control_points, float)
    values = GridEvaluator(old, surface.order, *places).points(net)
    for axis, (t, k, at) in enumerate(zip(knots, order, places, strict=True)):
        values = make_interp_spline(at, values, k - 1, t=t, axis=axis).c
        values = np.moveaxis(values, 0, axis) if axis else values
    return values
