"""How certain the errors of a fit are to be: at which parameters they are measured."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import numpy as np

from jaxfit._closest import closest_point
from jaxfit._splines import BSplineSurface

Feet = tuple[Any, Any, Any, Any]  # u, v, distance in the user's unit, converged


class AbstractErrors(eqx.Module):
    """Where the errors of a finished fit are measured."""

    @abstractmethod
    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """Feet on the fitted surface. `known` are the parameters that the fit ended with, and the errors
        there; `at_feet` says whether these are foot points.
        """


class AtParameters(AbstractErrors):
    """Errors at the parameters that the fit ended with: nothing is evaluated any more.

    Those of a method that holds the parameters it is given are upper bounds of the distances. The cheapest.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.AtParameters()
    AtParameters()
    """

    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """As they are."""
        return known


class LocalFeet(AbstractErrors):
    """Errors at local foot points: those that the iteration comes to from the parameters it ended with.

    Another part of the surface may be nearer.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.LocalFeet()
    LocalFeet()
    """

    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """The known ones, or those that lie downhill from them."""
        if at_feet:
            return known
        found = closest_point(surface, points, start=(known[0], known[1]))
        return found.u, found.v, found.distance, found.converged


class GlobalFeet(AbstractErrors):
    """Errors at true closest points: the whole surface is searched. The default of every method.

    Most feet are proven to be the nearest by a bound; the search goes on for the others. Inside
    transformations local feet stand in for them.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GlobalFeet()
    GlobalFeet()
    """

    def feet(self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool) -> Feet:
        """The nearest of all."""
        found = closest_point(surface, points)
        parts = (found.u, found.v, found.distance, found.converged)
        if not at_feet:
            return parts
        u, v, distance, converged = (np.array(np.asarray(x)) for x in known)
        other = [np.asarray(x) for x in parts]
        # A foot that has not converged is still on the surface: the distance is no less for that.
        nearer = other[3] & (other[2] <= distance * np.where(converged, 1 - 1e-6, 1.0))
        for mine, theirs in zip((u, v, distance, converged), other, strict=True):
            mine[nearer] = theirs[nearer]
        return u, v, distance, converged
