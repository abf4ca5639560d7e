"""Orthogonal distance: Gauss-Newton on the true distances, with the feet eliminated."""

from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax

from jaxfit._approximation._damping import Trust, farthest_move, is_plausible, next_damping
from jaxfit._approximation._distance_rows import normal_equations
from jaxfit._approximation._gauss_newton_step import gauss_newton_step
from jaxfit._approximation._knot_insertion import Growth, KnotInsertion, check_insertion
from jaxfit._approximation._losses import check_loss, loss_length, reweighted, total_cost
from jaxfit._approximation._second_order import second_order_rhs
from jaxfit._barrier import materialise
from jaxfit._checks import check_number, check_switches
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._loop import AbstractIterativeMethod, Limits, Measured, Turn
from jaxfit._fit._measure import border_on, measure_feet
from jaxfit._fit._problem import check_smoothing
from jaxfit._normal_equations import thin_plate
from jaxfit._splines._pieces import Pieces, pieces_on


class OrthogonalDistance(AbstractIterativeMethod):
    r"""Minimise the true distances of the points over the control points, by Gauss-Newton steps.

    With the closest point $u_k^*(P)$ of every point eliminated, minimises

    $$F = \sum_k w_k |Q_k - R(u_k^*(P))|^2 + \lambda F_s(P),$$

    $F_s$ being the thin plate (10) of `StandardApproximation`. That method holds the parameters while it
    solves, so that a point resists every move of the surface; here it resists only moves along the normal
    $n_k$, and the net is free to slide to where the detail is. Each step solves

    $$\Big(\sum_k w_k B_k^T (\Pi_k + \mu (I - \Pi_k)) B_k + \lambda A_{fair}\Big)\, \delta P
      = \sum_k w_k B_k^T (Q_k - R_k) - \lambda A_{fair} P,$$

    with the basis functions $B_k$ at the foot and the projection $\Pi_k$ on the normal space, for a surface
    in space $n_k n_k^T$. At a foot on the border of the domain only those tangent directions are taken off in
    which it is free to move. These rows are the exact derivative of the residual in the normal
    space, whatever the curvature; what is left out lies in the tangent space and is of second order in the
    distances.

    Where the net slides along the surface the distances change to second order only. So the step is followed
    by its correction, which solves the same system for the second derivatives of the residuals along it
    (geodesic acceleration), at the same feet and at most 0.75 times as long as the step.

    The damping mu lies between 0 and 1. At 1 the step is that of `StandardApproximation`, which never fails:
    the distance at the old parameters is at least the new one. The first step has mu = 1; after it mu
    follows the fall of F against the one foreseen. A step after which F, measured at converged feet, has
    not fallen is taken back, so that F never rises; so is one in which a foot has moved by several cells
    without the fall that was foreseen. It counts as an iteration, with the errors of the surface it went
    back to. F is judged at the feet that the fit follows; the errors it gives back are searched for anew on
    the whole surface.

    Parameters
    ----------
    smoothing : float
        lambda (default 5e-6), as for `StandardApproximation`; 0 for none. May be traced.
    fixed_boundary : bool
        Hold the border control points (section 2.3 of the paper); otherwise only the four corners.
    insertion : KnotInsertion(), optional
        New knots every few iterations where the errors are greatest; none by default.
    loss : Huber(), Tukey() or GemanMcClure(), optional
        For points with outliers; least squares by default.
    damping : float
        mu of the second step, in (0, 1] (default 0.01).
    reach : float
        Most that a control point moves in a step with mu below 1, correction included, as a share of the
        distance to its neighbours (default 0.6).
    foot_method, foot_tolerance, stall_window, stall_gain
        As for GeometricApproximation.

    Raises
    ------
    ValueError
        If `smoothing` is negative or not finite, `damping` not in (0, 1], or `reach` not positive.

    Notes
    -----
    The fit's `stats` say `smoothing`; `bending_energy`, $F_s$ in the squared unit of the data; `damping`, the
    last mu; and `retreats`, how many steps were taken back.

    Far from the points the feet say little, and like the paper's methods this one may fold a surface whose
    base is too far away, or whose net is too coarse for what it is asked; a base made with the points
    (`Meshless`, `DynamicBaseSurface`) or a finer net is the remedy. Where smoothing is 0, control points that
    few points see may travel far.

    This is tangent distance minimisation, damped: the Gauss-Newton method for variable projection (Golub and
    Pereyra, SIAM J. Numer. Anal. 10, 1973) of this problem; Wang, Pottmann and Liu, ACM Trans. Graph. 25,
    2006. The correction is that of Transtrum and Sethna (arXiv:1201.5885). It runs in the loop of all fits
    rather than in an optimistix solver: the objective is known only when feet have been found, these are
    taken back together with the net, and nets grow, for which the latter has no place. Given the residual
    `points - closest_point(surface, points).point`, whose derivative is implicit, `optimistix.least_squares`
    comes to the same minimum, with dense Jacobians or many passes over the points.
    """

    smoothing: Any = 5e-6
    fixed_boundary: bool = True
    insertion: KnotInsertion | None = None
    loss: Any = None
    damping: float = 1e-2
    reach: float = 0.6
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: float = 1e-12
    stall_window: int = 20
    stall_gain: float = 2e-3

    counts: ClassVar[bool] = True
    retreats: ClassVar[bool] = True

    def __check_init__(self) -> None:
        check_smoothing(self.smoothing)
        check_loss(self.loss)
        check_insertion(self.insertion)
        check_switches(self, ("fixed_boundary",))
        check_number("damping", self.damping, 0.0)
        if not 0 < self.damping <= 1:
            raise ValueError(
                f"damping must be greater than 0 and at most 1, but is {self.damping!r}; the default is 0.01."
            )
        check_number("reach", self.reach, 0.0)
        if self.reach == 0:
            raise ValueError("reach must be greater than 0, but is 0; the default is 0.6.")

    def prepared(self, problem: Any) -> tuple["OrthogonalDistance", Any]:
        """With lambda moved into the problem, so that another one compiles nothing."""
        return eqx.tree_at(lambda m: m.smoothing, self, 0.0), problem.smoothed(self.smoothing)

    def measure(
        self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, exact: Array
    ) -> Measured:
        """Feet from the last accepted ones."""
        idle = problem.padding <= 0
        feet = measure_feet(self.foot_method, problem, pieces, measured, idle, borders=False)
        active = jnp.sum(problem.weight > 0, dtype=jnp.int32)
        return eqx.tree_at(lambda m: m.active, feet, active, is_leaf=lambda x: x is None)

    def settle(self, problem: Any, turn: Turn, measured: Measured) -> tuple[Turn, Measured]:
        """The surface just measured if its objective is lower, or the one before."""
        trust: Any = turn.trust
        first = turn.step == 0
        axes, weight = turn.axes(problem), true_weight(problem)
        bending = problem.smoothing * thin_plate(*axes).energy(turn.net)
        # Both surfaces are judged by one scale of the loss.
        length = loss_length(self.loss, problem, jnp.where(first, measured.error, trust.error))
        before = total_cost(self.loss, length, weight, trust.error) + trust.bending
        gain = before - total_cost(self.loss, length, weight, measured.error) - bending
        way = farthest_move(axes, (trust.u, trust.v), (measured.u, measured.v), weight > 0)
        good = first | ((gain > 0) & is_plausible(trust, gain, way))
        damping = jnp.where(turn.step == 1, self.damping, next_damping(trust, before, gain, good))
        damping = jnp.where(first, trust.damping, damping)
        here = (turn.net, measured.u, measured.v, measured.error, measured.found, bending)
        kept = (trust.net, trust.u, trust.v, trust.error, trust.found, trust.bending)
        net, u, v, error, found, bending = lax.cond(good, lambda: here, lambda: kept)
        retreats = trust.retreats + ~good
        trust = Trust(net, u, v, error, found, bending, trust.foreseen, damping, retreats)
        measured = Measured(u, v, error, measured.steps, found, measured.active)
        return Turn(net, turn.step, turn.records, turn.growth, turn.shift, trust), measured

    def move(self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, turn: Turn) -> Turn:
        """New knots, and a step to be judged once it has been measured."""
        trust: Any = turn.trust
        net, growth = self._refined(problem, measured, turn)
        axes = turn.axes(problem) if growth is None else growth.axes
        length = loss_length(self.loss, problem, measured.error)
        weight = reweighted(self.loss, length, true_weight(problem), measured.error)
        held = border_on(axes, net.shape, corners_only=not self.fixed_boundary)
        always = problem.diagonal > 0
        feet = (measured.u, measured.v, weight)
        equations = materialise(
            always,
            lambda net, *x: normal_equations(problem, pieces_on(net, *axes), *x),
            *(net, *feet, trust.damping),
        )

        def correction_rhs(net: Array, move: Array) -> Array:
            pieces, moves = pieces_on(net, *axes), pieces_on(move, *axes)
            return materialise(always, partial(second_order_rhs, problem), pieces, moves, *feet)

        solve = partial(gauss_newton_step, axes, problem.smoothing, self.reach, correction_rhs)
        following, foreseen = materialise(always, solve, equations, net, held, trust.damping)
        trust = eqx.tree_at(lambda t: (t.net, t.foreseen), trust, (net, foreseen))
        return Turn(following, turn.step + 1, turn.records, growth, turn.shift, trust)

    def _refined(self, problem: Any, measured: Measured, turn: Turn) -> tuple[Array, Growth | None]:
        """The accepted net with new knots if it is time: the surface, and so its feet, are the same."""
        net, growth = turn.net, turn.growth
        if self.insertion is None or growth is None:
            return net, growth
        return lax.cond(
            turn.step > 0,
            partial(self.insertion, turn.step, measured=measured, real=problem.padding > 0),
            lambda net, growth: (net, growth),
            *(net, growth),
        )


def true_weight(problem: Any) -> Array:
    """Weights of the points, 0 for padding."""
    return jnp.where(problem.padding > 0, problem.weight, 0.0)
