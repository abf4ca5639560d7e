"""Geometric approximation of scattered points: Algorithm 1 of the paper (section 4.1), plain."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxfit._cells import (
    evaluate_values,
    local_coordinates,
    net_sums,
    row_coefficients,
    row_width,
    rows_of,
    staged,
)
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._loop import AbstractIterativeMethod, Limits, Measured, Turn
from jaxfit._fit._measure import border, measure_feet
from jaxfit._splines._pieces import Pieces


class GeometricApproximation(AbstractIterativeMethod):
    r"""Move every control point by the weighted mean of the error vectors around it.

    With the foot $(u_k, v_k)$ of every point and its error vector $e_k = Q_k - R(u_k, v_k)$,

    $$P_{ij} \leftarrow P_{ij} + \frac{\sum_k w_k N_i(u_k) N_j(v_k)\, e_k}{\sum_k w_k N_i(u_k) N_j(v_k)},$$

    then new feet, warm-started, and so on (Algorithm 1). A control point that no data point touches stays
    where it is. With the feet frozen this converges to the least-squares solution at their parameters
    (section 4.2); it gets coarse features right within a few iterations and fine ones slowly.

    Parameters
    ----------
    fixed_boundary : bool
        Hold the border control points (section 2.3 of the paper); otherwise only the four corners.
    foot_method : Newton() or HuWallner()
        How feet are brought up to date (default Newton).
    foot_tolerance : float
        To what tangential error, as a fraction of the diagonal. The paper's results do not depend on it
        between 1e-5 and 1e-12.
    stall_window, stall_gain : int, float
        The fit stops as stalled when neither error has fallen by the share `stall_gain` within
        `stall_window` iterations.
    """

    fixed_boundary: bool = True
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: float = 1e-12
    stall_window: int = 40
    stall_gain: float = 2e-3

    def move(self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, turn: Turn) -> Turn:
        """One step of Algorithm 1 from converged feet."""
        net = turn.net
        width = row_width(measured.u.shape[0], pieces.cells)
        rows = rows_of(pieces, measured.u, measured.v, width, problem.weight <= 0)

        def errors_in_rows() -> tuple[Array, Array, Array]:
            u, v, weight = rows.spread(jnp.stack([measured.u, measured.v, problem.weight]))
            s, t = local_coordinates(pieces, rows.cell[:, None], u, v)
            on_surface = evaluate_values(row_coefficients(pieces, rows), s, t)
            weight = jnp.where(rows.filled, weight, 0.0)
            error = rows.spread(problem.target) - on_surface
            return s, t, jnp.concatenate([weight[None] * error, weight[None]])

        s, t, values = staged(problem.diagonal > 0, errors_in_rows)
        sums = net_sums(rows, s, t, values, pieces.axis_u.polynomials, pieces.axis_v.polynomials)
        weight = sums[..., -1:]
        touched = weight > 0
        shift = jnp.where(touched, sums[..., :-1] / jnp.where(touched, weight, 1.0), 0.0)
        held = border(net.shape[0], net.shape[1], corners_only=not self.fixed_boundary)
        return Turn(jnp.where(held[..., None], net, net + shift), turn.step + 1, turn.records)

    def measure(self, problem: Any, pieces: Pieces, measured: Measured) -> Measured:
        """Feet from the last ones, converged on the new surface."""
        # The safeguard keeps the best foot there is, and the final check looks again: no borders here.
        idle = problem.padding <= 0
        return measure_feet(self.foot_method, problem, pieces, measured, idle, borders=False)
