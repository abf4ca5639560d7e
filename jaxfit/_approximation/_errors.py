"""`GlobalFeet`, `LocalFeet` and `AtParameters`: where the errors of a finished fit are measured."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import numpy as np

from jaxfit._approximation._room import Room, nearest_on
from jaxfit._checks import is_concrete
from jaxfit._closest import closest_point
from jaxfit._splines import BSplineSurface

Feet = tuple[Any, Any, Any, Any]  # u, v, distance in the user's unit, converged


class AbstractErrors(eqx.Module):
    """Where the errors of a finished fit are measured."""

    @abstractmethod
    def feet(
        self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool, room: Room | None = None
    ) -> Feet:
        """Feet on the fitted surface. `known` are the parameters that the fit ended with, and the errors
        there; `at_feet` says whether these are foot points. `room` is that of the fit.
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

    def feet(
        self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool, room: Room | None = None
    ) -> Feet:
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

    def feet(
        self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool, room: Room | None = None
    ) -> Feet:
        """The known ones if they are feet, or else the local feet found from them."""
        if not at_feet:
            found = closest_point(surface, points, start=(known[0], known[1]))
            known = found.u, found.v, found.distance, found.converged
        return _searched_again(surface, points, known, room) if is_concrete(surface, points, known) else known


def _searched_again(surface: BSplineSurface, points: Any, known: Feet, room: Room | None) -> Feet:
    """With the nearest feet on the whole surface where local ones have not converged and are farther."""
    lost = np.flatnonzero(~np.asarray(known[3]))
    if not len(lost):
        return known
    found = _as_feet(nearest_on(surface, np.asarray(points)[lost], room=room))
    nearer = found[2] < np.asarray(known[2])[lost]
    arrays = [np.array(x) for x in known]
    for array, new in zip(arrays, found, strict=True):
        array[lost[nearer]] = new[nearer]
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

    def feet(
        self, surface: BSplineSurface, points: Any, known: Feet, at_feet: bool, room: Room | None = None
    ) -> Feet:
        """The nearest feet on the whole surface."""
        if not is_concrete(surface, points, known):
            found = closest_point(surface, points)
            return found.u, found.v, found.distance, found.converged
        if not at_feet:
            known = LocalFeet().feet(surface, points, known, at_feet, room)
        return _as_feet(nearest_on(surface, points, known, room))


def _as_feet(found: Any) -> Feet:
    return found["u"], found["v"], found["distance"], found["converged"]
