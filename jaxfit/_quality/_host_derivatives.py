"""Derivatives of a surface on a grid of parameters, by NumPy in double precision: nothing compiles."""

from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._host_splines import basis_matrix
from jaxfit._splines import BSplineSurface

ROUNDINGS = 4  # units in the last place by which control points are uncertain


class UnitSurface:
    """A surface with its domain taken to the unit square and its net to the unit cube round the origin.

    Control points behind surplus knots at the right end, which have no influence, are left out.
    """

    def __init__(self, surface: BSplineSurface):
        net = np.asarray(surface.control_points)
        self.order = surface.order
        self.knots, used, self.domain = [], [], []
        for knots, order, count in zip(
            (surface.knots_u, surface.knots_v), self.order, surface.shape, strict=True
        ):
            values = np.asarray(knots, np.float64)
            low, high = values[order - 1], values[count]
            last = int(np.searchsorted(values, high))
            self.knots.append((values[: last + order] - low) / (high - low))
            self.domain.append((float(low), float(high)))
            used.append(last)
        eps = float(np.finfo(net.dtype).eps)
        net = net[: used[0], : used[1]].astype(np.float64)
        low, high = net.min(axis=(0, 1)), net.max(axis=(0, 1))
        self.centre = 0.5 * low + 0.5 * high
        self.scale = float(np.max(high - self.centre)) or 1.0
        self.net = np.moveaxis((net - self.centre) / self.scale, 2, 0)
        largest = max(np.abs(low).max(), np.abs(high).max()) / self.scale
        self.rounding = ROUNDINGS * max(eps, float(np.finfo(np.float64).eps)) * max(float(largest), 1.0)

    def at(self, u: Float[np.ndarray, " a"], v: Float[np.ndarray, " b"]) -> "HostDerivatives":
        """Its derivatives on a grid of parameters of the unit square."""
        return HostDerivatives(self, u, v)

    @cached_property
    def breaks(self) -> list[np.ndarray]:
        """Ends of the spans of positive width, along u and along v."""
        return [np.unique(np.clip(knots, 0.0, 1.0)) for knots in self.knots]

    def parameters(self, unit: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Parameters of the surface itself."""
        low, high = np.transpose(self.domain)
        return low + (high - low) * unit


class HostDerivatives:
    """d^(i+j) R / du^i dv^j at all combinations of `u` and `v`, coordinate first."""

    def __init__(self, surface: UnitSurface, u: np.ndarray, v: np.ndarray):
        self._surface, self._at = surface, (u, v)
        self._matrices: dict[tuple[int, int], Any] = {}
        self._along_v: dict[int, list[np.ndarray]] = {}

    def __call__(self, du: int, dv: int) -> Float[np.ndarray, "d a b"]:
        if dv not in self._along_v:
            self._along_v[dv] = [(self._matrix(1, dv) @ x.T).T for x in self._surface.net]
        return np.stack([self._matrix(0, du) @ x for x in self._along_v[dv]])

    def rounding(self, axis: int) -> Float[np.ndarray, " count"]:
        """How far rounded control points can take the first derivative along `axis`."""
        return self._surface.rounding * abs(self._matrix(axis, 1)).sum(axis=1)

    def _matrix(self, axis: int, derivative: int) -> Any:
        if (axis, derivative) not in self._matrices:
            from scipy.sparse import csr_array

            surface = self._surface
            dense = basis_matrix(surface.knots[axis], surface.order[axis], self._at[axis], derivative)
            self._matrices[axis, derivative] = csr_array(dense)
        return self._matrices[axis, derivative]
