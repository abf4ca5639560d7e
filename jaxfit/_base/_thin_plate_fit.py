"""Tensor-product least squares with a thin plate, on nets whose border control points are given or free."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._base._host_splines import Knots, basis_matrix
from jaxfit._symmetric_solve import solved_on_diagonal

OUTLIER_RATIO = 20.0  # times the median residual: where a point has half its weight
LEAST_RESIDUAL = 1e-9  # of the diagonal: a residual this small is rounding
REGULARISATION = 1e-13  # of the mean diagonal entry


def _tensor_rows(first: Any, second: Any) -> Any:
    """Row k is the Kronecker product of row k of each: sparse (points, columns x columns)."""
    from scipy.sparse import csr_array

    first, second = csr_array(first), csr_array(second)
    count, (k, m) = first.shape[0], (first.indptr[1], second.indptr[1])
    values = first.data.reshape(count, k, 1) * second.data.reshape(count, 1, m)
    columns = first.indices.reshape(count, k, 1).astype(int) * second.shape[1]
    columns = columns + second.indices.reshape(count, 1, m)
    rows = np.arange(count + 1) * (k * m)
    shape = (count, first.shape[1] * second.shape[1])
    return csr_array((values.ravel(), columns.ravel(), rows), shape=shape)


def _thin_plate_matrix(knots: tuple[np.ndarray, np.ndarray], order: tuple[int, int]) -> Any:
    r"""Sparse matrix of $\int |R_{uu}|^2 + 2 |R_{uv}|^2 + |R_{vv}|^2$ (10), index i nv + j."""
    from scipy.sparse import kron

    u, v = (_derivative_products(t, k) for t, k in zip(knots, order, strict=True))
    return (kron(u[2], v[0]) + 2 * kron(u[1], v[1]) + kron(u[0], v[2])).tocsr()


def _derivative_products(knots: np.ndarray, order: int) -> list[Any]:
    """Integrals of products of the basis functions, and of their first and second derivatives."""
    from scipy.sparse import csr_array

    nodes, weights = np.polynomial.legendre.leggauss(order)  # exact for the degree
    breaks = np.unique(knots)
    half, middle = np.diff(breaks)[:, None] / 2, (breaks[1:] + breaks[:-1])[:, None] / 2
    at, root = (middle + half * nodes).ravel(), np.sqrt(half * weights).reshape(-1, 1)
    rows = [csr_array(root * basis_matrix(knots, order, at, derivative)) for derivative in range(3)]
    return [x.T @ x for x in rows]


class ThinPlateFit:
    r"""The net that minimises $\sum_k w_k |R(u_k, v_k) - Q_k|^2 + \lambda F$.

    Its border is that of `start`, or free. F is the thin plate over the unit square; $\lambda$ is `smoothing`
    times the trace of the matrix of the sum with all w = 1, over that of F. With `smoothing` > 0 there is one
    solution whatever the points, if the border is given, and with three that are not in line, if it is free.
    """

    def __init__(
        self,
        start: Float[Any, "nu nv d"],
        knots: Knots,
        order: tuple[int, int],
        places: Float[Any, "points 2"],
        points: Float[Any, "points d"],
        free_border: bool = False,
    ):
        from scipy.interpolate import BSpline

        parts = [BSpline.design_matrix(x, t, k - 1) for t, k, x in zip(knots, order, places.T, strict=True)]
        self.knots, self.order, self.places, self.points = knots, order, places, points
        self._start, self._free = start, np.full(start.shape[:2], free_border)
        self._free[1:-1, 1:-1] = True
        self._rows, self._plate = _tensor_rows(*parts), _thin_plate_matrix(knots, order)
        self._trace = float((self._rows.data**2).sum())

    def robust_weights(
        self, smoothing: float, rounds: int
    ) -> tuple[Float[Any, "nu nv d"], Float[Any, " points"]]:
        """The net and w: 1 at first, then falling with the residual over its median in each of the rounds."""
        weights = np.ones(len(self.points))
        net = self.net(weights, smoothing)
        for _ in range(rounds):
            residual = np.linalg.norm(self._rows @ net.reshape(-1, net.shape[2]) - self.points, axis=1)
            usual = max(OUTLIER_RATIO * float(np.median(residual)), LEAST_RESIDUAL)
            weights = 1 / (1 + (residual / usual) ** 2)
            net = self.net(weights, smoothing)
        return net, weights

    def net(self, weights: Float[Any, " points"], smoothing: float) -> Float[Any, "nu nv d"]:
        """The minimum with these weights."""
        from scipy.sparse import diags_array

        nu, nv, d = self._start.shape
        free, held = np.flatnonzero(self._free), np.flatnonzero(~self._free)
        if not len(free):
            return self._start
        normal = self._rows.T @ diags_array(weights) @ self._rows
        system = (normal + smoothing * self._trace / self._plate.diagonal().sum() * self._plate).tocsr()
        flat = self._start.reshape(-1, d).copy()
        right = (self._rows.T @ (weights[:, None] * self.points))[free] - system[free][:, held] @ flat[held]
        # Where the plate has no bending (order 2) it leaves a control point without points undecided.
        shift = REGULARISATION * self._trace / len(flat)
        inner = system[free][:, free] + shift * diags_array(np.ones(len(free)))
        flat[free] = solved_on_diagonal(inner, right + shift * flat[free])
        return flat.reshape(nu, nv, d)
