"""Tensor-product splines by dense matrices on the host: nothing compiles for a new size of grid."""

from typing import Any

import numpy as np
from jaxtyping import Float

Knots = tuple[Float[Any, " knots_u"], Float[Any, " knots_v"]]


def basis_matrix(
    knots: Float[Any, " knots"], order: int, u: Float[Any, " points"], derivative: int = 0
) -> Float[Any, "points n"]:
    """All basis functions, or their derivatives, at `u`."""
    from scipy.interpolate import BSpline

    return BSpline(knots, np.eye(len(knots) - order), order - 1)(u, derivative)


def along_both(
    first: Float[Any, "a n"], net: Float[Any, "n m *d"], second: Float[Any, "b m"]
) -> Float[Any, "a b *d"]:
    """One matrix along each direction of a net."""
    return np.swapaxes(np.tensordot(second, np.tensordot(first, net, 1), (1, 1)), 0, 1)


class GridEvaluator:
    """Points and normals of the surfaces of one spline space, on one grid of parameters."""

    def __init__(
        self, knots: Knots, order: tuple[int, int], u: np.ndarray, v: np.ndarray, dtype: Any = float
    ):
        self._u = [basis_matrix(knots[0], order[0], u, k).astype(dtype) for k in (0, 1)]
        self._v = [basis_matrix(knots[1], order[1], v, k).astype(dtype) for k in (0, 1)]

    def points(self, net: Float[Any, "nu nv *d"], du: int = 0, dv: int = 0) -> Float[Any, "a b *d"]:
        """R(u_a, v_b), or a first derivative."""
        return along_both(self._u[du], net.astype(self._u[0].dtype), self._v[dv])

    def normals(self, net: Float[Any, "nu nv 3"]) -> Float[Any, "a b 3"]:
        """Unit normals, zero where the surface has none."""
        along_u = self.points(net, 1, 0)
        cross = np.cross(along_u, self.points(net, 0, 1))
        length = np.linalg.norm(cross, axis=2, keepdims=True)
        return cross / np.where(length > 0, length, 1.0)


def halve_widest_spans(
    net: Float[Any, "nu nv d"], knots: Knots, order: tuple[int, int], least: tuple[int, int]
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The same surface, its widest spans halved until it has at least so many control points each way."""
    from scipy.interpolate import BSpline

    refined = []
    for axis in (0, 1):
        curve = BSpline(knots[axis], np.moveaxis(net, axis, 0), order[axis] - 1)
        while (count := len(curve.t) - order[axis]) < least[axis]:
            widths = np.diff(curve.t)
            widest = int(np.argmax(widths > widths.max() * (1 - 1e-9)))
            curve = curve.insert_knot((curve.t[widest] + curve.t[widest + 1]) / 2)
        net = np.moveaxis(curve.c[:count], 0, axis)
        refined.append(curve.t)
    return net, (refined[0], refined[1])
