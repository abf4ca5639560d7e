"""Geometric interpolation of grids: section 3 of the paper, plain."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxfit._cells import values_at
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._loop import AbstractIterativeMethod, Measured
from jaxfit._fit._measure import border, measure_feet
from jaxfit._parameters import AbstractParametrisation, ChordLength
from jaxfit._splines._pieces import Pieces


class GeometricInterpolation(AbstractIterativeMethod):
    r"""Move every control point by the error vector of its own data point, until all vanish.

    The control net starts as the data (12). In every iteration the closest point of each $Q_{ij}$ on the
    surface is found, warm-started, and with $e_{ij} = Q_{ij} - R(\hat u_{ij}, \hat v_{ij})$ (13)

    $$P_{ij} \leftarrow P_{ij} + e_{ij} \quad (14)$$

    except at the four corners, which the surface interpolates from the start. The slowest errors fall by a
    factor of about 0.92 an iteration, so 1e-12 of the diagonal takes some 200.

    Parameters
    ----------
    parametrisation : ChordLength() or Centripetal()
        Of the grid's rows and columns; its averages give knots (5) and first feet. Centripetal is better
        where the data takes sharp turns.
    foot_method : Newton() or HuWallner()
        How feet are brought up to date (default Newton).
    foot_tolerance : float
        To what tangential error, as a fraction of the diagonal.
    stall_window, stall_gain : int, float
        The fit stops as stalled when neither error has fallen by the share `stall_gain` within
        `stall_window` iterations, as it does at rounding level.
    """

    parametrisation: AbstractParametrisation = ChordLength()
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: float = 1e-13
    stall_window: int = 40
    stall_gain: float = 0.1

    def move(self, problem: Any, net: Array, pieces: Pieces, measured: Measured) -> Array:
        """Equations (13) and (14) from converged feet."""
        error = problem.target - values_at(pieces, measured.u, measured.v)
        held = border(net.shape[0], net.shape[1], corners_only=True)
        return jnp.where(held[..., None], net, net + error.T.reshape(net.shape))

    def measure(self, problem: Any, pieces: Pieces, measured: Measured) -> Measured:
        """Closest points from the last ones."""
        nu, nv = (x.cells + k - 1 for x, k in zip((pieces.axis_u, pieces.axis_v), pieces.order, strict=True))
        corners = border(nu, nv, corners_only=True).reshape(-1)
        return measure_feet(self.foot_method, problem, pieces, measured, corners, borders=True)
