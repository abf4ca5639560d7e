"""The nets that a growing fit goes through: with a boundary, and for a sheet without."""

import dataclasses
from abc import ABC, abstractmethod
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxfit._base import (
    AbstractBaseMethod,
    Boundary,
    Coons,
    Meshless,
    MeshlessAt,
    base_at_parameters,
    base_surface,
    carried_base,
    cloud_of,
    default_base,
    meshless_at,
    net_of_ratio,
    net_of_sides,
    net_of_size,
)
from jaxfit._scan import Sheet
from jaxfit._splines import BSplineSurface

FIRST_SIZE = 8.0  # control points along each direction of a square patch
MOST_SIZE = 96  # control points along either direction of a sheet, which may be rough at all scales

MOST_FRESH = 64**2  # control points of the largest net that is fitted anew
MOST_MESHLESS = 20_000  # points whose parameters are found
MUCH = 1.25
SIDES_MOST = 150  # control points that the sides are given along either direction to begin with

Feet = tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]


class AbstractNets(ABC):
    """Nets of every size, and a surface taken from one to another.

    `points_a_control_point` is the least number of points for each control point of any net. `carries` says
    whether a surface that is carried keeps what a coarser net has made of its parameters.
    """

    points_a_control_point: ClassVar[float]
    carries: ClassVar[bool]
    order: tuple[int, int]

    @abstractmethod
    def net(self, size: float, most: int) -> tuple[int, int]:
        """About `size` squared control points along u and v, at most `most` each way."""

    @abstractmethod
    def base(self, net: tuple[int, int]) -> BSplineSurface:
        """The surface that fits on this net begin with."""

    @abstractmethod
    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """`surface` with another net."""

    @abstractmethod
    def fresh(self, points: Float[np.ndarray, "points d"], net: tuple[int, int]) -> BSplineSurface | None:
        """A surface made of the points alone, whatever coarser nets have made of them; None if there is none,
        or it takes too long."""

    @abstractmethod
    def feet(self, net: tuple[int, int]) -> Feet | None:
        """Those of the points on every surface that is new to them, if known."""


@dataclasses.dataclass
class BoundaryNets(AbstractNets):
    """The sides are those of the boundary with every net."""

    points_a_control_point, carries = 2.0, True
    boundary: Boundary
    order: tuple[int, int]
    points: Float[np.ndarray, "points d"]
    method: Coons | AbstractBaseMethod | None = None  # of the base surfaces

    def net(self, size: float, most: int) -> tuple[int, int]:
        """Shared between the directions by the lengths of the sides; more where the sides have waves, which
        the first net shows already, and later ones refine with the root of the size."""
        net = net_of_size(size, self.boundary, self.order, most)
        finer = np.sqrt(max(size / FIRST_SIZE, 1.0))
        nu, nv = (int(max(n, min(least * finer, most))) for n, least in zip(net, self._least, strict=True))
        return nu, nv

    @cached_property
    def _least(self) -> tuple[int, int]:
        """What the sides take where the first net has much less; 0 elsewhere."""
        least = net_of_sides(self.boundary, self.order, SIDES_MOST)
        if self.points_a_control_point * least[0] * least[1] > len(self.points):
            return 0, 0
        usual = net_of_size(FIRST_SIZE, self.boundary, self.order, SIDES_MOST)
        nu, nv = (n if n > MUCH * other else 0 for n, other in zip(least, usual, strict=True))
        return nu, nv

    def base(self, net: tuple[int, int]) -> BSplineSurface:
        """By the method, or the default one."""
        if self.method is None:
            return default_base(self.boundary, self.points, net, self.order, lambda: self.meshless)
        return base_surface(self.boundary, self.points, net=net, order=self.order, method=self.method)

    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """On the knots of the boundary curves, with these as sides."""
        return carried_base(surface, self.boundary, net, self.order)

    def fresh(self, points: Float[np.ndarray, "points d"], net: tuple[int, int]) -> BSplineSurface | None:
        """Smoothed, at parameters that come from neighbours and not from a projection."""
        if points.shape[1] != 3 or net[0] * net[1] > MOST_FRESH:
            return None
        return base_surface(self.boundary, points, net=net, order=self.order, method=self.meshless)

    @cached_property
    def meshless(self) -> MeshlessAt:
        """The meshless surface of any net, at parameters that are found once."""
        return meshless_at(Meshless(most_points=MOST_MESHLESS), cloud_of(self.points, self.boundary))

    def feet(self, net: tuple[int, int]) -> None:
        """To be searched."""


@dataclasses.dataclass
class SheetNets(AbstractNets):
    """Surfaces beyond the sheet on all sides, each at parameters made for it."""

    points_a_control_point, carries = 3.0, False  # some of these points are where no sheet is
    sheet: Sheet
    order: tuple[int, int]

    def net(self, size: float, most: int) -> tuple[int, int]:
        """Shared between the directions by the sides of the sheet laid out flat."""
        ratio = float(np.sqrt(self.sheet.sides[0] / self.sheet.sides[1]))
        most = min(most, MOST_SIZE)
        return net_of_ratio(min(size, most / max(ratio, 1 / ratio)), ratio, self.order, most)

    def base(self, net: tuple[int, int]) -> BSplineSurface:
        """A smoothed surface."""
        some = self.sheet.on_sheet
        points = self.sheet.points[some] * self.sheet.size + self.sheet.centre
        layout = self.sheet.layout(net, self.order)
        return base_at_parameters(points, layout.parameters[some], layout.knots, self.order)

    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """A smoothed surface as well: what a coarse net made of the parameters is forgotten."""
        return self.base(net)

    def fresh(self, points: Float[np.ndarray, "points d"], net: tuple[int, int]) -> None:
        """All bases are."""

    def feet(self, net: tuple[int, int]) -> Feet:
        """The parameters of all finite points; those that are not on the sheet get their neighbours'."""
        parameters = self.sheet.layout(net, self.order).parameters[self.sheet.nearest]
        return parameters[:, 0], parameters[:, 1]
