"""Geometric approximation of scattered points: Algorithm 1 of the paper (section 4.1)."""

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
from jaxfit._fit._fairing import Fairing
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
    relaxation : float
        How far control points follow, as a multiple of the mean (default 1, the paper's). Safe below 2, since
        the largest eigenvalue of the iteration with feet held is 1; 1.7 takes about two thirds of the
        iterations.
    fairing : Fairing(), optional
        Laplacian fairing of the net every few iterations (section 4.3); none by default.
    local : bool, default False
        Let only those points pull whose error exceeds the tolerance on the maximum error, or on the average
        error where there is none; control points they do not touch stay (section 4.1).
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
    relaxation: float = 1.0
    fairing: Fairing | None = None
    local: bool = False
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: float = 1e-12
    stall_window: int = 40
    stall_gain: float = 2e-3

    def __check_init__(self) -> None:
        if not 0 < self.relaxation < 2:
            raise ValueError(
                f"relaxation must lie between 0 and 2, where the iteration converges, but is "
                f"{self.relaxation!r}; 1 is the paper's, 1.7 is fast."
            )
        if self.fairing is not None and self.stall_window % self.fairing.every:
            raise ValueError(
                f"stall_window must be a multiple of the {self.fairing.every} iterations from one fairing to "
                f"the next, but is {self.stall_window}; change one of them."
            )

    def move(self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, turn: Turn) -> Turn:
        """One step of Algorithm 1 from converged feet."""
        net = turn.net
        weight = problem.weight
        if self.local:
            threshold = jnp.where(jnp.isfinite(limits.maximum), limits.maximum, limits.average)
            weight = jnp.where(measured.error > threshold * problem.diagonal, weight, 0.0)
        width = row_width(measured.u.shape[0], pieces.cells)
        rows = rows_of(pieces, measured.u, measured.v, width, weight <= 0)

        def errors_in_rows() -> tuple[Array, Array, Array]:
            u, v, pull = rows.spread(jnp.stack([measured.u, measured.v, weight]))
            s, t = local_coordinates(pieces, rows.cell[:, None], u, v)
            on_surface = evaluate_values(row_coefficients(pieces, rows), s, t)
            pull = jnp.where(rows.filled, pull, 0.0)
            error = rows.spread(problem.target) - on_surface
            return s, t, jnp.concatenate([pull[None] * error, pull[None]])

        s, t, values = staged(problem.diagonal > 0, errors_in_rows)
        sums = net_sums(rows, s, t, values, pieces.axis_u.polynomials, pieces.axis_v.polynomials)
        total = sums[..., -1:]
        touched = total > 0
        shift = jnp.where(touched, sums[..., :-1] / jnp.where(touched, total, 1.0), 0.0)
        held = border(net.shape[0], net.shape[1], corners_only=not self.fixed_boundary)
        moved = jnp.where(held[..., None], net, net + self.relaxation * shift)
        step = turn.step + 1
        if self.fairing is not None:
            moved = jnp.where(step % self.fairing.every == 0, self.fairing(moved), moved)
        return Turn(moved, step, turn.records, turn.shift)

    def measure(self, problem: Any, pieces: Pieces, measured: Measured) -> Measured:
        """Feet from the last ones, converged on the new surface."""
        # The safeguard keeps the best foot there is, and the final check looks again: no borders here.
        idle = problem.padding <= 0
        return measure_feet(self.foot_method, problem, pieces, measured, idle, borders=False)
