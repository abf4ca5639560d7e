"""`StandardApproximation`: least squares with a thin plate, equations (8) to (11) of the paper."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._approximation._automatic_smoothing import AbstractSmoothing, select_smoothing
from jaxfit._approximation._differentiable_solution import unrolled_solution
from jaxfit._approximation._knot_insertion import KnotInsertion, check_insertion, room_for
from jaxfit._approximation._linear_least_squares import (
    AbstractLeastSquares,
    GaussNewton,
    least_squares_problem,
)
from jaxfit._approximation._losses import check_loss, loss_length, reweighted
from jaxfit._approximation._smoothing_term import as_smoothing, check_smoothing, constant_plate, plate_of
from jaxfit._cells import distances_at
from jaxfit._checks import Scalar, check_kind, check_switches, is_concrete
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._border import AbstractBorder, FixedBorder, check_border, held_points
from jaxfit._fit._feet import measure_feet
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._method import AbstractIterativeMethod, Iterate
from jaxfit._fit._method_fields import check_common_fields
from jaxfit._fit._problem import Problem
from jaxfit._fit._stationarity_condition import StationarityCondition
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import RegularisedSystem, ThinPlate, WeightedPlate, make_system
from jaxfit._unrolling import unrolled


class StandardState(eqx.Module):
    """lambda, the largest shift of a singular matrix (a share of its diagonal), and the thin plate."""

    smoothing: Float[Any, ""]
    shift: Float[Any, ""]
    plate: ThinPlate | None


class StandardApproximation(AbstractIterativeMethod):
    r"""Least squares with a thin plate, and corrected parameters.

    Minimises over the control points, with the parameters $(u_k, v_k)$ of the points held,

    $$F = \sum_k w_k |R(u_k, v_k) - Q_k|^2 + \lambda \int_0^1\!\!\int_0^1
        |R_{uu}|^2 + 2 |R_{uv}|^2 + |R_{vv}|^2 \, du\, dv,$$

    equations (8) and (10). Then the parameters of the closest points on the new surface replace the old ones,
    and so on. The domain counts as $[0, 1]^2$; lambda has no unit. Control points that neither data nor
    smoothing determines do not move. Without smoothing, control points that influence few points may move
    far.

    Parameters
    ----------
    smoothing : float, GeneralizedCrossValidation() or Discrepancy(noise)
        lambda (default 2e-5, the paper's for two of its three models); 0 for none. May be traced. An object
        chooses lambda from the data before the iteration begins.
    parameter_correction : bool
        Whether parameters are corrected (default True). False solves once, at the parameters given as `start`
        or found on the base surface, whatever `stall_window` is, and the history records errors at these
        parameters.
    border : FixedBorder(), FixedCorners(), FreeBorder() or FixedSides(...)
        Which control points on the border of the net stay (default all of them, section 2.3).
    solver : GaussNewton(), LevenbergMarquardt(), JaxoptGaussNewton() or JaxoptLevenbergMarquardt()
        How the least-squares problem is solved (default GaussNewton, direct). All agree to rounding.
    insertion : KnotInsertion(), optional
        New knots every few iterations where the errors are greatest (default none).
    loss : Huber(), Tukey() or GemanMcClure(), optional
        For data with outliers: points are reweighted in each iteration (default least squares).
    foot_method, foot_tolerance, stall_window, stall_gain
        As for GeometricApproximation (defaults Newton(), 1e-12, 20, 2e-3).

    Raises
    ------
    ValueError
        If `smoothing` is negative or not finite.
    TypeError
        If a field is of the wrong kind.

    Notes
    -----
    The fit's `stats` contain `smoothing`, the lambda in force, NaN where one was to be chosen and the base
    surface met the tolerances without; `bending_energy`, the integral above in the
    squared unit of the data; and `shift`. A normal matrix that is nearly singular is shifted by this share of
    its diagonal; 0 for a regular one. It is singular without smoothing where the points are too few for the
    net. The system is solved for the correction of the present surface, so that whatever the data does not
    determine does not change.

    Examples
    --------
    >>> method = jf.StandardApproximation(smoothing=1e-6, insertion=jf.KnotInsertion())
    >>> method.finds_feet, method.border, method.solver
    (True, FixedBorder(), GaussNewton())
    >>> jf.StandardApproximation(parameter_correction=False).finds_feet
    False
    """

    smoothing: Any = 2e-5
    parameter_correction: bool = True
    border: AbstractBorder = FixedBorder()
    solver: Any = GaussNewton()
    insertion: KnotInsertion | None = None
    loss: Any = None
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: Scalar = 1e-12
    stall_window: int = 20
    stall_gain: Scalar = 2e-3

    def __check_init__(self) -> None:
        check_kind("solver", self.solver, AbstractLeastSquares, "GaussNewton()")
        if not isinstance(self.smoothing, AbstractSmoothing):
            check_smoothing(self.smoothing, "GeneralizedCrossValidation() or Discrepancy(noise)")
        check_loss(self.loss)
        check_insertion(self.insertion)
        check_border(self.border)
        check_common_fields(self)
        check_switches(self, ("parameter_correction",))

    @property
    def finds_feet(self) -> bool:
        """Whether parameters are corrected: they are then those of foot points."""
        return self.parameter_correction

    @property
    def stall_after(self) -> int:
        """The field, or 1 for parameters that are kept: a second solve would give the same."""
        return self.stall_window if self.parameter_correction else 1

    @property
    def stall_since(self) -> int:
        """The first iteration."""
        return 0

    def init(
        self, problem: Problem, surface: WorkingSurface, projection: FootPoints
    ) -> tuple[WorkingSurface, StandardState]:
        """lambda as given, or chosen from the data."""
        if isinstance(self.smoothing, AbstractSmoothing):
            smoothing = select_smoothing(self.smoothing, self, problem, surface, projection)
        else:
            smoothing = as_smoothing(self.smoothing, problem.target.dtype)
        xp: Any = np if is_concrete(problem, smoothing) else jnp
        plate = constant_plate(self.insertion, surface)
        surface = room_for(self.insertion, surface, problem.tolerances.max_steps)
        return surface, StandardState(smoothing, xp.zeros_like(smoothing), plate)

    def held(self, surface: WorkingSurface) -> Bool[Any, "nu nv"]:
        """Control points that do not move."""
        return held_points(self.border, surface.control_points.shape, surface.used)

    def system(
        self,
        problem: Problem,
        surface: WorkingSurface,
        projection: FootPoints,
        smoothing: Any,
        plate: ThinPlate | None = None,
    ) -> RegularisedSystem:
        """The least-squares problem at the present parameters."""
        length = loss_length(self.loss, problem, surface.axes, projection.error)
        weight = reweighted(self.loss, length, problem.weight, projection.error)
        parameters = projection.u, projection.v
        return make_system(surface.pieces, *parameters, problem.target, weight, smoothing, plate)

    def project(self, problem: Problem, surface: WorkingSurface, before: FootPoints) -> FootPoints:
        """Feet on the new surface, or without correction the errors at the same parameters."""
        if self.parameter_correction:
            return measure_feet(self.foot_method, problem, surface.pieces, before, self.foot_tolerance)
        real = jnp.asarray(problem.real)
        distance = distances_at(surface.pieces, before.u, before.v, problem.target, real)
        active = jnp.sum(problem.counted, dtype=jnp.int32)
        return FootPoints(
            *(before.u, before.v, distance, before.evaluations, real, active, jnp.asarray(True)),
            before.summary,
        )

    def measure(self, problem: Problem, iterate: Iterate, exact: Array) -> tuple[FootPoints, StandardState]:
        """Feet, or without correction the errors at the same parameters."""
        return self.project(problem, iterate.surface, iterate.projection), iterate.state

    def accept(self, problem: Problem, old: Iterate, new: Iterate) -> Iterate:
        """The new iterate: errors may rise on the way."""
        return new

    def move(self, problem: Problem, iterate: Iterate, history: ErrorHistory) -> tuple[Iterate, ErrorHistory]:
        """The least-squares net at the present parameters, then new knots if it is time."""
        surface, here, state = iterate.surface, iterate.projection, iterate.state
        system = self.system(problem, surface, here, state.smoothing, state.plate)
        solve = unrolled_solution if unrolled() else self.solver
        net, shift = solve(least_squares_problem(system, self.held(surface), surface.control_points))
        net = net + 0.0 * state.smoothing  # NaN for a traced lambda that is none
        surface, step = surface.moved_to(net), iterate.step + 1
        if self.insertion is not None:
            surface = self.insertion(step, surface, here, problem.counted)
        state = StandardState(state.smoothing, jnp.maximum(state.shift, shift), state.plate)
        return Iterate(surface, here, state, step), history

    def stationarity(
        self, problem: Problem, surface: WorkingSurface, state: StandardState, error: Array
    ) -> StationarityCondition:
        """Half the gradient of F. A lambda chosen from the data counts as constant."""
        length = loss_length(self.loss, problem, surface.axes, error)
        chosen = isinstance(self.smoothing, AbstractSmoothing)
        smoothing = state.smoothing if chosen else as_smoothing(self.smoothing, error.dtype)
        penalty = WeightedPlate(plate_of(state.plate, surface), jnp.asarray(smoothing))
        weight = reweighted(self.loss, length, problem.weight, error)
        return StationarityCondition(weight, self.held(surface), penalty)

    def postprocess(
        self, problem: Problem, iterate: Iterate, stopped_early: Array
    ) -> tuple[Iterate, dict[str, Any]]:
        """The iterate as it is; lambda, the integral (10), and the largest shift."""
        energy = plate_of(iterate.state.plate, iterate.surface).energy(iterate.surface.control_points)
        stats = {"bending_energy": energy * problem.scale**2}
        smoothing = iterate.state.smoothing
        if isinstance(self.smoothing, AbstractSmoothing):
            smoothing = jnp.where(iterate.step > 0, smoothing, jnp.nan)
        return iterate, stats | {"smoothing": smoothing, "shift": iterate.state.shift}
