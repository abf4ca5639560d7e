"""The nets that a growing fit goes through: with a boundary, and for a sheet without."""

from abc import abstractmethod

import equinox as eqx

from jaxfit._base import Boundary, carried_base, carried_free_base, net_of_ratio, net_of_size
from jaxfit._splines import BSplineSurface


class AbstractNets(eqx.Module):
    """Nets of every size, and a surface taken from one to another."""

    @abstractmethod
    def net(self, size: float, most: int) -> tuple[int, int]:
        """About `size` squared control points along u and v, at most `most` each way."""

    @abstractmethod
    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """`surface` with another net."""


class BoundaryNets(AbstractNets):
    """The sides are those of the boundary with every net."""

    boundary: Boundary
    order: tuple[int, int]

    def net(self, size: float, most: int) -> tuple[int, int]:
        """Shared between the directions by the lengths of the sides."""
        return net_of_size(size, self.boundary, self.order, most)

    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """On the knots of the boundary curves, with these as sides."""
        return carried_base(surface, self.boundary, net, self.order)


class FreeNets(AbstractNets):
    """Uniform knots; `ratio` squared is the length of the domain along u over that along v."""

    ratio: float
    order: tuple[int, int]

    def net(self, size: float, most: int) -> tuple[int, int]:
        """Shared between the directions by the sides of the domain."""
        return net_of_ratio(size, self.ratio, self.order, most)

    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """Interpolated on other knots."""
        return carried_free_base(surface, net, self.order)
