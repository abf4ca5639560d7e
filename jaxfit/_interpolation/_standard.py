"""`StandardInterpolation`: the collocation system of sections 2.2 and 3 of the paper."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxfit._checks import check_kind, check_number
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._reasons import RESULTS, code_of
from jaxfit._interpolation._gmres import GmresLimits, distances
from jaxfit._interpolation._method import (
    AbstractDirectInterpolation,
    GridProblem,
    Solution,
    errors_only,
    refuse_normals,
    single_entry,
)
from jaxfit._interpolation._parameter_correction import CollocationProblem, corrected, solved_at
from jaxfit._interpolation._solution_derivative import with_derivative
from jaxfit._interpolation._tensor_collocation import tensor_collocation
from jaxfit._parameters import AbstractParametrisation, ChordLength, grid_parameters
from jaxfit._splines import averaging_knots
from jaxfit._splines._pieces import make_axis


class StandardInterpolation(AbstractDirectInterpolation):
    r"""Solve the linear system $\sum_{kl} N_k(u_{ij}) N_l(v_{ij}) P_{kl} = Q_{ij}$ for the control points.

    By default all points of a row share $u_i$ and all points of a column share $v_j$, the averages
    of the rows' and columns' own parameters. The system is then a tensor product and takes two passes of
    banded elimination, $O(nm(K + L))$ in all; the errors are at rounding level.

    Parameters
    ----------
    parametrisation : ChordLength() or Centripetal()
        Of the grid's rows and columns; its averages give the knots (5).
    per_point : bool, default False
        Whether every point keeps the parameters $(u_{ij}, v_{ij})$ it has in its own row and column. The
        sparse system is solved by GMRES, preconditioned by the tensor product.
    parameter_correction : bool, default False
        Whether to replace the parameters by those of the closest points and to solve again, until they no
        longer move or, where they do not converge, the errors stop falling.
    max_corrections : int, default 10
        Most corrections.
    foot_tolerance : float, default 1e-13
        To what tangential error closest points are found, as a fraction of the diagonal.
    restart : int, default 20
        Iterations in a cycle of GMRES; it needs memory for as many nets.

    Raises
    ------
    ValueError
        If a number is out of range.
    TypeError
        If a choice is not one of its kind, or an option is no number.

    Notes
    -----
    The tensor product always has a solution (Schoenberg-Whitney), with derivatives of any order in the
    data: parameters and knots follow the data. Where neighbours are very unevenly spaced the
    control points, and with them the rounding errors, grow with the order; `Centripetal()` or a lower order
    helps.

    The knots suit the averages. Where rows differ from these by about the distance of two neighbours, the
    system of `per_point` is nearly singular or has no solution; the fit then ends as stalled, on the best
    surface found.

    A surface that passes through its data at its parameters needs no correction: the points are their own
    closest points. Correction matters where the system of `per_point` could not be solved. Derivatives
    leave out how corrections move.

    In `Fit.stats`, `num_steps` counts cycles of GMRES (0 for the tensor product alone), `corrections` the
    corrections, and `parameter_change` is the greatest change of a parameter in the last one. `errors`
    carry no derivative.

    Source: section 2.2 of Kineri, Wang, Lin and Maekawa (2012); C. de Boor, A Practical Guide to Splines,
    chapter XIII, for the banded elimination.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.StandardInterpolation().iterative, jf.StandardInterpolation(per_point=True).iterative
    (False, True)
    """

    parametrisation: AbstractParametrisation = ChordLength()
    per_point: bool = False
    parameter_correction: bool = False
    max_corrections: int = 10
    foot_tolerance: float = 1e-13
    restart: int = 20

    def __check_init__(self) -> None:
        check_kind(
            "parametrisation", self.parametrisation, AbstractParametrisation, "ChordLength() or Centripetal()"
        )
        check_number("max_corrections", self.max_corrections, 0, whole=True)
        check_number("foot_tolerance", self.foot_tolerance, 0.0)
        check_number("restart", self.restart, 1, whole=True)

    @property
    def iterative(self) -> bool:
        """Whether more than the tensor product is to be solved."""
        return self.per_point or self.parameter_correction

    @staticmethod
    def check_normals(normals: Any, grid: Any, order: tuple[int, int]) -> Any:
        """None can be met."""
        refuse_normals("StandardInterpolation", normals)

    def solve(self, problem: GridProblem, history: ErrorHistory) -> Solution:
        """The tensor product, and where asked the general system after it."""
        data, order, frame = problem.data, problem.order, problem.frame
        parameters = grid_parameters(data, self.parametrisation)
        averaged = parameters.u, parameters.v
        knots = averaging_knots(averaged[0], order[0]), averaging_knots(averaged[1], order[1])
        tensor = tensor_collocation(knots, order, *averaged)
        net = tensor.solve(data)
        if self.per_point:
            u, v = parameters.rows_u, parameters.rows_v
        else:
            u = jnp.broadcast_to(averaged[0][:, None], data.shape[:2])
            v = jnp.broadcast_to(averaged[1][None, :], data.shape[:2])
        limits = GmresLimits(frame.diagonal, frame.goal, frame.max_steps)
        if self.iterative:
            axes = make_axis(knots[0], order[0], simple=True), make_axis(knots[1], order[1], simple=True)
            system = CollocationProblem(data, knots, axes, tensor, limits)
            return _iterated(self, system, net, u, v, history)
        errors = distances(lax.stop_gradient(data - tensor.times(net)), frame.diagonal)
        zero = np.int32(0)
        code = _ending(jnp.max(errors) <= frame.goal, RESULTS.stalled)
        stats = {"corrections": zero, "parameter_change": np.zeros((), data.dtype)}
        return Solution(net, knots, u, v, errors, single_entry(errors), code, zero, zero, stats)


def _ending(met: Array, missed: Any) -> Array:
    return jnp.where(met, np.int32(code_of(RESULTS.converged)), np.int32(code_of(missed)))


def _iterated(
    method: StandardInterpolation,
    problem: CollocationProblem,
    net: Array,
    u: Array,
    v: Array,
    history: ErrorHistory,
) -> Solution:
    """The general system, from the net of the tensor product, and corrections of the parameters."""
    fixed, net, start_u, start_v = lax.stop_gradient((problem, net, u, v))
    found = solved_at(method, fixed, net, start_u, start_v, jnp.zeros((), jnp.int32), history)
    if method.parameter_correction:
        found = corrected(method, fixed, found)
    found = lax.stop_gradient(found)
    # Derivatives see the first parameters, moved by constants.
    u, v = u + (found.u - start_u), v + (found.v - start_v)
    net = with_derivative(method.restart, found.net, (u, v), problem.axes, problem.tensor, problem.data)
    errors = fixed.errors(found.net, found.u, found.v)
    goal, most = problem.limits.tolerance, problem.limits.max_steps
    met = jnp.max(errors) <= goal
    code = jnp.where(
        found.step >= most, _ending(met, RESULTS.max_steps_reached), _ending(met, RESULTS.stalled)
    )
    stats = {
        "corrections": found.number,
        "parameter_change": jnp.where(found.number > 0, found.change, 0.0),
    }
    past = errors_only(found.history, found.step)
    return Solution(net, problem.knots, u, v, errors, past, code, found.step, found.lost, stats)
