"""Control points and knots in the form that other programs take."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfit._splines import BSplineSurface

_FAR = 100  # diagonals from the origin; farther away, formats and CAD kernels lose digits


class ClampedNet(NamedTuple):
    """A surface in three dimensions, float64, whose end knots are repeated exactly as often as its order."""

    control_points: Float[np.ndarray, "nu nv 3"]
    knots_u: Float[np.ndarray, " knots_u"]
    knots_v: Float[np.ndarray, " knots_v"]
    order: tuple[int, int]

    @property
    def diagonal(self) -> float:
        """That of the bounding box of the control points."""
        return float(np.linalg.norm(np.ptp(self.control_points, axis=(0, 1))))

    @property
    def domain(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """First and last parameter along u, and along v."""
        u, v = self.knots_u, self.knots_v
        return (float(u[0]), float(u[-1])), (float(v[0]), float(v[-1]))


def clamped_net(surface: BSplineSurface) -> ClampedNet:
    """The same surface on clamped knots, without control points that have no influence.

    Raises
    ------
    ValueError
        If the surface is not in three dimensions, or may jump at a knot.
    """
    if surface.dimension != 3:
        raise ValueError(
            f"surface must be in three dimensions for this format, but has {surface.dimension}; write .npz "
            "or .json, or use affine() to take it there."
        )
    missing = [
        _missing_ends(np.asarray(knots), order)
        for knots, order in zip((surface.knots_u, surface.knots_v), surface.order, strict=True)
    ]
    if any(map(len, missing)):
        surface = surface.insert_knots(*missing)
    net = np.asarray(surface.control_points, np.float64)
    net, knots_u = _without_surplus(net, surface.knots_u, surface.order[0], "knots_u")
    net, knots_v = _without_surplus(np.swapaxes(net, 0, 1), surface.knots_v, surface.order[1], "knots_v")
    return ClampedNet(np.ascontiguousarray(np.swapaxes(net, 0, 1)), knots_u, knots_v, surface.order)


def near_origin(net: ClampedNet) -> tuple[ClampedNet, Float[np.ndarray, " 3"]]:
    """The net with large coordinates moved to the origin, and what was subtracted: a round number each.

    A coordinate is large if the centre is more than 100 diagonals away from zero.
    """
    corners = net.control_points.min(axis=(0, 1)), net.control_points.max(axis=(0, 1))
    centre, diagonal = 0.5 * corners[0] + 0.5 * corners[1], net.diagonal
    if not diagonal:
        return net, np.zeros(3)
    round_number = np.round(centre, -int(np.floor(np.log10(diagonal))))
    offset = np.where(np.abs(centre) > _FAR * diagonal, round_number, 0.0)
    return net._replace(control_points=net.control_points - offset), offset


def _missing_ends(knots: np.ndarray, order: int) -> list[float]:
    """Knots to be inserted so that both ends of the domain are repeated as often as the order."""
    ends = knots[order - 1], knots[-order]
    return [float(end) for end in ends for _ in range(order - int((knots == end).sum()))]


def _without_surplus(net: np.ndarray, knots: Any, order: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Net and knots from one end of the domain to the other."""
    knots = np.asarray(knots, np.float64)
    first = int(np.searchsorted(knots, knots[order - 1], "right")) - order
    last = int(np.searchsorted(knots, knots[-order])) + order
    knots, net = knots[first:last], net[first : last - order]
    values, repeats = np.unique(knots[order:-order], return_counts=True)
    if (repeats >= order).any():
        jump = values[np.argmax(repeats)]
        raise ValueError(
            f"surface must not jump, but {name} repeats {jump:g} as often as its order {order}; write .npz "
            "or .json, which can hold that."
        )
    return net, knots
