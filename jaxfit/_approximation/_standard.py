"""Standard approximation of scattered points: section 2.3 of the paper, equations (8) to (11)."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool

from jaxfit._approximation._automatic_smoothing import AbstractSmoothing, select_smoothing
from jaxfit._approximation._knot_insertion import KnotInsertion, check_insertion
from jaxfit._approximation._least_squares import AbstractLeastSquares, GaussNewton, least_squares_problem
from jaxfit._approximation._losses import check_loss, loss_length, reweighted
from jaxfit._cells import values_at
from jaxfit._checks import check_kind, check_switches
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._loop import AbstractIterativeMethod, Limits, Measured, Turn
from jaxfit._fit._measure import border_on, measure_feet
from jaxfit._fit._problem import check_smoothing
from jaxfit._normal_equations import RegularisedSystem, make_system, thin_plate
from jaxfit._splines._pieces import Axis, Pieces


class StandardApproximation(AbstractIterativeMethod):
    r"""Least squares with a thin plate, and corrected parameters.

    Minimises over the control points, with the parameters $(u_k, v_k)$ of the points held,

    $$F = \sum_k w_k |R(u_k, v_k) - Q_k|^2 + \lambda \int_0^1\!\!\int_0^1
        |R_{uu}|^2 + 2 |R_{uv}|^2 + |R_{vv}|^2 \, du\, dv,$$

    equations (8) and (10), then takes the closest points on the new surface as parameters, and so on. The
    domain counts as $[0, 1]^2$; lambda has no unit, and weighs against a plain sum over the points. Control
    points that neither data nor smoothing reaches, or hardly, stay where they are; without smoothing those
    that few points see may travel far.

    Parameters
    ----------
    smoothing : float, GeneralizedCrossValidation() or Discrepancy(noise)
        lambda (default 2e-5, the paper's for two of its three models); 0 for none. May be traced. An object
        chooses it from the data before the iteration begins.
    parameter_correction : bool
        False solves once, at the parameters given as `start` or found on the base surface. The loop then
        measures errors at these parameters; the errors of the fit are at true closest points nevertheless.
    fixed_boundary : bool
        Hold the border control points (section 2.3); otherwise only the four corners.
    solver : GaussNewton(), LevenbergMarquardt(), JaxoptGaussNewton() or JaxoptLevenbergMarquardt()
        How the least-squares problem is solved (default GaussNewton, direct). All agree to rounding.
    insertion : KnotInsertion(), optional
        New knots every few rounds where the errors are greatest; none by default.
    loss : Huber(), Tukey() or GemanMcClure(), optional
        For points with outliers, which are weighed anew in each round; least squares by default.
    foot_method, foot_tolerance, stall_window, stall_gain
        As for GeometricApproximation.

    Raises
    ------
    ValueError
        If `smoothing` is negative or not finite.

    Notes
    -----
    The fit's `stats` say `smoothing`, the lambda in force; `bending_energy`, the integral above in the
    squared unit of the data; and `shift`, by what share of its diagonal a normal matrix had to be shifted
    because it was nearly singular, as it is without smoothing where points are fewer than a net needs: 0 for
    a regular one. What is solved for is the correction of the present surface, so that what the data leaves
    open stays as it is.
    """

    smoothing: Any = 2e-5
    parameter_correction: bool = True
    fixed_boundary: bool = True
    solver: Any = GaussNewton()
    insertion: KnotInsertion | None = None
    loss: Any = None
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: float = 1e-12
    stall_window: int = 20
    stall_gain: float = 2e-3

    counts: ClassVar[bool] = True
    solves: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not self.parameter_correction:
            self.stall_window = 1  # a second solve would give the same

    def __check_init__(self) -> None:
        check_kind("solver", self.solver, AbstractLeastSquares, "GaussNewton()")
        if not isinstance(self.smoothing, AbstractSmoothing):
            check_smoothing(self.smoothing)
        check_loss(self.loss)
        check_insertion(self.insertion)
        check_switches(self, ("fixed_boundary", "parameter_correction"))

    def prepared(self, problem: Any) -> tuple["StandardApproximation", Any]:
        """With lambda moved into the problem, so that another one compiles nothing; 0 until it is chosen."""
        value = 0.0 if isinstance(self.smoothing, AbstractSmoothing) else self.smoothing
        return eqx.tree_at(lambda m: m.smoothing, self, 0.0), problem.smoothed(value)

    def held(self, axes: tuple[Axis, Axis], net: Array) -> Bool[Array, "nu nv"]:
        """Which control points stay."""
        return border_on(axes, net.shape, corners_only=not self.fixed_boundary)

    def system(self, problem: Any, pieces: Pieces, measured: Measured) -> RegularisedSystem:
        """The least-squares problem at the present parameters."""
        length = loss_length(self.loss, problem, measured.error)
        weight = reweighted(self.loss, length, problem.weight, measured.error)
        return make_system(pieces, measured.u, measured.v, problem.target, weight, problem.smoothing)

    def move(self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, turn: Turn) -> Turn:
        """The net of least squares at the present parameters."""
        held = self.held((pieces.axis_u, pieces.axis_v), turn.net)
        net, shift = self.solver(
            least_squares_problem(self.system(problem, pieces, measured), held, turn.net)
        )
        before: Any = turn.shift
        step, growth = turn.step + 1, turn.growth
        if self.insertion is not None and growth is not None:
            net, growth = self.insertion(step, net, growth, measured, problem.padding > 0)
        return Turn(net, step, turn.records, growth, jnp.maximum(before, shift))

    def measure(
        self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, exact: Array
    ) -> Measured:
        """New parameters, or the errors at the old ones."""
        idle = problem.padding <= 0
        active = jnp.sum(problem.weight > 0, dtype=jnp.int32)
        if self.parameter_correction:
            feet = measure_feet(self.foot_method, problem, pieces, measured, idle, borders=False)
            return eqx.tree_at(lambda m: m.active, feet, active, is_leaf=lambda x: x is None)
        error = values_at(pieces, measured.u, measured.v) - problem.target
        distance = jnp.sqrt(jnp.sum(jnp.where(idle[None], 0.0, error) ** 2, axis=0))
        return Measured(measured.u, measured.v, distance, measured.steps, ~jnp.asarray(idle), active)


def with_smoothing(rule: Any, method: StandardApproximation, problem: Any, net: Array, u: Any, v: Any) -> Any:
    """The problem with the lambda that a rule chooses; as it is where lambda was given as a number."""
    if not isinstance(rule, AbstractSmoothing):
        return problem
    return eqx.tree_at(lambda p: p.smoothing, problem, select_smoothing(rule, method, problem, net, u, v))


@jax.jit
def bending_energy(net: Array, axis_u: Axis, axis_v: Axis) -> Array:
    """The integral (10) of a net."""
    return thin_plate(axis_u, axis_v).energy(net)
