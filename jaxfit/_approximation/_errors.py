"""`GlobalFeet`, `LocalFeet` and `AtParameters`: where the errors of a finished fit are measured."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import numpy as np

from jaxfit._checks import is_concrete
from jaxfit._closest import Newton, closest_point, nearest_feet
from jaxfit._precision import default_foot_tolerance
from jaxfit._splines import BSplineSurface
from jaxfit._splines._pieces import make_axis

MAX_STEPS = 60  # evaluations of a foot in the global search

Feet = tuple[Any, Any, Any, Any]  # u, v, distance in the user's unit, converged


class AbstractErrors(eqx.Module):
    """Where the errors of a finished fit are measured."""

    @abstractmethod
    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """Feet on the fitted surface. `known` are the parameters that the fit ended with, and the errors
        there; `at_feet` says whether these are foot points.
        """


class AtParameters(AbstractErrors):
    """Errors at the parameters that the fit ended with: no further evaluation, so the cheapest.

    Where the method holds given parameters, these errors are upper bounds of the distances.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.AtParameters()
    AtParameters()
    """

    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """The known ones."""
        return known


class LocalFeet(AbstractErrors):
    """Errors at local foot points, found from the parameters that the fit ended with.

    Another part of the surface may be nearer. Where none is found, the whole surface is searched.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.LocalFeet()
    LocalFeet()
    """

    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """The known ones if they are feet, or else the local feet found from them."""
        if not at_feet:
            found = closest_point(surface, points, start=(known[0], known[1]))
            known = found.u, found.v, found.distance, found.converged
        return _searched_again(surface, points, known) if is_concrete(surface, points, known) else known


def _searched_again(surface: BSplineSurface, points: Any, known: Feet) -> Feet:
    """With the nearest feet on the whole surface where local ones have not converged and are farther."""
    lost = np.flatnonzero(~np.asarray(known[3]))
    if not len(lost):
        return known
    found = closest_point(surface, np.asarray(points)[lost])
    nearer = np.asarray(found.distance) < np.asarray(known[2])[lost]
    arrays = [np.array(x) for x in known]
    for array, new in zip(arrays, (found.u, found.v, found.distance, found.converged), strict=True):
        array[lost[nearer]] = np.asarray(new)[nearer]
    return arrays[0], arrays[1], arrays[2], arrays[3]


class GlobalFeet(AbstractErrors):
    """Errors at true closest points: the whole surface is searched. The default of every method.

    In large clouds, feet well below the reach of the surface, which is estimated from samples, count as the
    nearest; the others are searched for. Neither is a proof (see `closest_point`). Inside transformations
    a fit that ends on feet keeps its local ones.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GlobalFeet()
    GlobalFeet()
    """

    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """The nearest feet on the whole surface."""
        if not is_concrete(surface, points, known):
            found = closest_point(surface, points)
            return found.u, found.v, found.distance, found.converged
        if not at_feet:
            known = LocalFeet().feet(surface, points, known, at_feet)
        knots = [np.asarray(x) for x in (surface.knots_u, surface.knots_v)]
        axis_u, axis_v = (make_axis(x, order) for x, order in zip(knots, surface.order, strict=True))
        net = np.asarray(surface.control_points)
        tolerance = default_foot_tolerance(net.dtype)
        found = nearest_feet(
            Newton(),
            net,
            axis_u,
            axis_v,
            np.asarray(points),
            known=known,
            tolerance=tolerance,
            max_steps=MAX_STEPS,
        )
        return found["u"], found["v"], np.sqrt(found["f"]), found["converged"]
