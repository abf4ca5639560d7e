"""The nets that a growing fit goes through: with a boundary, and for a sheet without."""

import dataclasses
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxfit._base import Boundary, carried_base, free_base, net_of_ratio, net_of_size
from jaxfit._scan import Sheet
from jaxfit._splines import BSplineSurface

MOST_SIZE = 96  # control points along either direction of a sheet, which may be rough at all scales

Feet = tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]


class AbstractNets(ABC):
    """Nets of every size, and a surface taken from one to another.

    `points_a_control_point` is the least number of points for each control point of any net.
    """

    points_a_control_point: ClassVar[float]

    @abstractmethod
    def net(self, size: float, most: int) -> tuple[int, int]:
        """About `size` squared control points along u and v, at most `most` each way."""

    @abstractmethod
    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """`surface` with another net."""

    @abstractmethod
    def feet(self, net: tuple[int, int]) -> Feet | None:
        """Those of the points on every surface that is new to them, if known."""


@dataclasses.dataclass
class BoundaryNets(AbstractNets):
    """The sides are those of the boundary with every net."""

    points_a_control_point = 2.0
    boundary: Boundary
    order: tuple[int, int]

    def net(self, size: float, most: int) -> tuple[int, int]:
        """Shared between the directions by the lengths of the sides."""
        return net_of_size(size, self.boundary, self.order, most)

    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """On the knots of the boundary curves, with these as sides."""
        return carried_base(surface, self.boundary, net, self.order)

    def feet(self, net: tuple[int, int]) -> None:
        """To be searched."""


@dataclasses.dataclass
class SheetNets(AbstractNets):
    """Surfaces beyond the sheet on all sides, each at parameters made for it."""

    points_a_control_point = 3.0  # some of these are where no points are
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
        return free_base(points, layout.parameters[some], layout.knots, self.order)

    def carried(self, surface: BSplineSurface, net: tuple[int, int]) -> BSplineSurface:
        """A smoothed surface as well: what a coarse net made of the parameters is forgotten."""
        return self.base(net)

    def feet(self, net: tuple[int, int]) -> Feet:
        """The parameters of all finite points; those that are not on the sheet get their neighbours'."""
        parameters = self.sheet.layout(net, self.order).parameters[self.sheet.nearest]
        return parameters[:, 0], parameters[:, 1]
