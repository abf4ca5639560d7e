"""Both bending energies of a surface, equations (9) and (10) of the paper, by Gauss's rule on the host."""

import numpy as np
from jaxtyping import Float

from jaxfit._normal_equations import curvature_density
from jaxfit._quality._host_derivatives import UnitSurface

NODES = 6  # in each span at least, as in `curvature_energy`; (10) needs as many as the order to be exact
BLOCK = 100_000  # nodes at a time


def energies(surface: UnitSurface) -> tuple[float, float | None]:
    """The thin-plate energy (10) over the unit square, in the squared unit of the net, and the curvature
    energy (9), which only surfaces in space have.
    """
    (u, weights_u), (v, weights_v) = (
        _gauss(breaks, max(NODES, order)) for breaks, order in zip(surface.breaks, surface.order, strict=True)
    )
    spatial = surface.net.shape[0] == 3
    plate = curvature = 0.0
    rows = max(1, BLOCK // len(v))
    for begin in range(0, len(u), rows):
        some = slice(begin, begin + rows)
        at = surface.at(u[some], v)
        second = at(2, 0), at(1, 1), at(0, 2)
        weight = np.outer(weights_u[some], weights_v)
        squares = (np.sum(x**2, axis=0) for x in second)
        plate += float(sum(k * np.sum(weight * x) for k, x in zip((1, 2, 1), squares, strict=True)))
        if spatial:
            curvature += float(np.sum(weight * curvature_density(at(1, 0), at(0, 1), *second)))
    return plate * surface.scale**2, curvature if spatial else None


def _gauss(
    breaks: Float[np.ndarray, " breaks"], count: int
) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
    """Nodes and weights of all spans together."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    half = 0.5 * np.diff(breaks)[:, None]
    return (breaks[:-1, None] + half * (1 + nodes)).ravel(), (half * weights).ravel()
