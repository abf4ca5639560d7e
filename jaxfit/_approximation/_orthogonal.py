"""`OrthogonalDistance`: Gauss-Newton on the true distances, with the feet eliminated."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._approximation._damping import (
    CORRECTED_BELOW,
    GUARDED_DAMPING,
    USUAL_DAMPING,
    DampingState,
    actual_gain,
    farthest_move,
    first_damping,
    is_no_worse,
    longest_moves,
    next_damping,
)
from jaxfit._approximation._distance_rows import normal_equations, rows_with_influence
from jaxfit._approximation._gauss_newton_step import gauss_newton_step
from jaxfit._approximation._knot_insertion import KnotInsertion, check_insertion, room_for
from jaxfit._approximation._losses import DataTerm, check_loss, loss_length, reweighted, total_cost
from jaxfit._approximation._regular_smoothing import SETTLED_AT, FoldGuard, RegularSmoothing
from jaxfit._approximation._second_order_correction import second_order_rhs
from jaxfit._approximation._smoothing_term import (
    as_smoothing,
    check_smoothing,
    constant_plate,
    plate_of,
)
from jaxfit._barrier import materialise
from jaxfit._checks import Scalar, check_number, is_concrete
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._border import AbstractBorder, FixedBorder, FreeBorder, check_border, held_points
from jaxfit._fit._feet import measure_feet
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._method import AbstractIterativeMethod, Iterate
from jaxfit._fit._method_fields import check_common_fields
from jaxfit._fit._problem import Problem
from jaxfit._fit._stationarity_condition import StationarityCondition
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import AbstractPenalty, ThinPlate, WeightedPlate
from jaxfit._splines._pieces import pieces_on


class StepSums(eqx.Module):
    """Sums over the points that decide on a step: the data term before and after it, and the longest move of
    a foot.
    """

    costs: Float[Any, "2"]
    longest_move: Float[Any, " devices"]


class OrthogonalState(eqx.Module):
    """The damping of the steps, the smoothing term of the last one, and sums over the points.

    With RegularSmoothing() there is a `guard`; without it lambda, `smoothing`, against the sum of the
    weights. `plate` is the thin plate of a fit that keeps its knots.
    """

    damping: DampingState
    penalty: AbstractPenalty
    guard: FoldGuard | None
    smoothing: Float[Any, ""]
    plate: ThinPlate | None
    sums: StepSums


class OrthogonalDistance(AbstractIterativeMethod):
    r"""Minimise the true distances of the points over the control points, by Gauss-Newton steps.

    With the closest point $u_k^*(P)$ of every point eliminated, minimises

    $$F = \sum_k w_k |Q_k - R(u_k^*(P))|^2 + S(P),$$

    with a smoothing term S, a quadratic form $P^T A_S P$: by default that of `RegularSmoothing`, or the
    thin-plate energy (10) times $\lambda \sum_k w_k$. `StandardApproximation` holds the parameters while
    it solves, so that a point resists every move of the surface. Here a point resists only moves along the
    normal $n_k$; the net may slide along the surface. Each step solves

    $$\Big(\sum_k w_k B_k^T (\Pi_k + \mu (I - \Pi_k)) B_k + A_S\Big)\, \delta P
      = \sum_k w_k B_k^T (Q_k - R_k) - A_S P,$$

    with the basis functions $B_k$ at the foot and the projection $\Pi_k$ on the normal space, for a surface
    in space $n_k n_k^T$. At a foot on the border of the domain $\Pi_k$ removes only the tangent directions in
    which the foot is free to move. These rows are the exact derivative of the residual in the normal space,
    whatever the curvature. The part left out lies in the tangent space and is of second order in the
    distances.

    Where the net slides along the surface the distances change to second order only. So steps with mu below
    0.002 get a correction (geodesic acceleration): the solution of the same system for the second derivatives
    of the residuals along the step, at the same feet and at most 0.75 times as long as the step. While the
    weight of `RegularSmoothing` still fades everywhere there is none: the next step has another objective
    anyway.

    The damping mu lies between 0 and 1. At 1 the step is that of `StandardApproximation`, which never fails:
    the distance at the old parameters is at least the new one. The first step has mu = 1, or less where
    `RegularSmoothing` begins at a base near the points. After it mu follows the ratio of the actual to the
    predicted reduction of F. A step is rejected if F, measured at converged feet, has risen. It is also
    rejected if a foot has moved by several cells and the reduction is less than predicted. A rejected step
    counts as an iteration, with the errors of the surface before it. F is measured at local feet. With
    `RegularSmoothing` a step is also rejected if the surface would fold where it did not, and taken again
    with more smoothing there.

    Parameters
    ----------
    smoothing : RegularSmoothing() or float
        Default RegularSmoothing(), which keeps a surface without folds free of them and fades as the errors
        fall. A number is lambda of the thin plate, weighed against the mean over the points, so that it
        means the same for any number of them: `sum(weights)` times it is lambda of `StandardApproximation`
        and of the paper, weighed against the sum. 0 for none. A number may be traced.
    border : FixedBorder(), FixedCorners(), FreeBorder() or FixedSides(...)
        Which control points on the border of the net stay (default all of them, section 2.3 of the paper).
    insertion : KnotInsertion(), optional
        New knots every few iterations where the errors are greatest (default none).
    loss : Huber(), Tukey() or GemanMcClure(), optional
        For data with outliers (default least squares).
    damping : float
        mu after the first step, if that is accepted, in (0, 1] (default 0.01).
    reach : float
        The longest move of a control point in a step with mu below 1, correction included, as a share of the
        distance to its neighbours (default 0.6).
    foot_method, foot_tolerance, stall_window, stall_gain
        As for GeometricApproximation (defaults Newton(), 1e-12, 20, 1e-2).

    Raises
    ------
    ValueError
        If `smoothing` is negative or not finite, `damping` not in (0, 1], or `reach` not positive.
    TypeError
        If a field is of the wrong kind.

    Notes
    -----
    The fit's `stats` contain `damping`, the last mu, and `rejected_steps`, the number of rejected steps. With
    RegularSmoothing also `points_out_of_reach`: points four times as far as the average one where the surface
    has been kept from folding, such as those of a pocket under the sheet. With a thin plate also `smoothing`,
    lambda, and `bending_energy`, the integral (10) in the squared unit of the data.

    Folds of the base surface may stay, at a fixed corner for instance. With a thin plate or without smoothing
    new ones may form where the base is far from the points, the net too coarse, or the points lie in a
    pocket. Where smoothing is 0, control points that influence few points may move far.

    This is tangent distance minimisation, damped: the Gauss-Newton method for variable projection (Golub and
    Pereyra, SIAM J. Numer. Anal. 10, 1973) of this problem; Wang, Pottmann and Liu, ACM Trans. Graph. 25,
    2006. The correction is that of Transtrum and Sethna (arXiv:1201.5885). The method runs in the loop of all
    fits rather than in an optimistix solver, because the objective needs feet, which are restored together
    with the net after a rejected step, and because nets grow. `optimistix.least_squares` on the residual
    `points - closest_point(surface, points).point` comes to the same minimum, with dense Jacobians or many
    passes over the points.

    Examples
    --------
    >>> method = jf.OrthogonalDistance(loss=jf.Huber(), border=jf.FixedCorners())
    >>> method.smoothing.least, method.damping, method.reach
    (3.0, 0.01, 0.6)
    >>> jf.OrthogonalDistance(damping=2.0)
    Traceback (most recent call last):
    ...
    ValueError: damping must be greater than 0 and at most 1, but is 2.0; the default is 0.01.
    """

    smoothing: Any = RegularSmoothing()
    border: AbstractBorder = FixedBorder()
    insertion: KnotInsertion | None = None
    loss: Any = None
    damping: Scalar = 1e-2
    reach: Scalar = 0.6
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: Scalar = 1e-12
    stall_window: int = 20
    stall_gain: Scalar = 1e-2

    def __check_init__(self) -> None:
        if not isinstance(self.smoothing, RegularSmoothing):
            check_smoothing(self.smoothing, "RegularSmoothing()")
        check_loss(self.loss)
        check_insertion(self.insertion)
        check_border(self.border)
        check_common_fields(self)
        check_number("damping", self.damping, 0.0)
        if is_concrete(self.damping) and not 0 < self.damping <= 1:
            raise ValueError(
                f"damping must be greater than 0 and at most 1, but is {self.damping!r}; the default is 0.01."
            )
        check_number("reach", self.reach, 0.0)
        if is_concrete(self.reach) and self.reach == 0:
            raise ValueError("reach must be greater than 0, but is 0; the default is 0.6.")

    @property
    def stall_since(self) -> int:
        """The first iteration; with `RegularSmoothing` the one by which its second smoothing has faded."""
        return SETTLED_AT if isinstance(self.smoothing, RegularSmoothing) else 0

    @property
    def finds_feet(self) -> bool:
        """True: feet are found in every iteration."""
        return True

    def init(
        self, problem: Problem, surface: WorkingSurface, projection: FootPoints
    ) -> tuple[WorkingSurface, OrthogonalState]:
        """The surface with room for new knots, and a first step with mu = 1, which cannot fail."""
        dtype = problem.target.dtype
        surface = room_for(self.insertion, surface, problem.tolerances.max_steps)
        damping = first_damping(surface, dtype)
        sums = StepSums(np.zeros(2, dtype), np.zeros(problem.devices, dtype))
        if isinstance(self.smoothing, RegularSmoothing):
            guard, nothing = self.smoothing.begin(surface)
            return surface, OrthogonalState(damping, nothing, guard, np.zeros((), dtype), None, sums)
        smoothing = as_smoothing(self.smoothing, dtype) * problem.total(problem.weight.sum())
        plate = constant_plate(self.insertion, surface)
        penalty = WeightedPlate(plate_of(plate, surface), smoothing)
        return surface, OrthogonalState(damping, penalty, None, smoothing, plate, sums)

    def measure(self, problem: Problem, iterate: Iterate, exact: Array) -> tuple[FootPoints, OrthogonalState]:
        """Converged feet, starting from the last accepted ones, and the folds."""
        surface, state, before = iterate.surface, iterate.state, iterate.projection
        here = measure_feet(self.foot_method, problem, surface.pieces, before, self.foot_tolerance)
        # Both surfaces are compared with the same scale of the loss.
        length = loss_length(self.loss, problem, surface.axes, before.error)
        cost = jax.vmap(partial(total_cost, self.loss, length, problem.weight))
        longest = farthest_move(surface.axes, (before.u, before.v), (here.u, here.v), problem.counted)
        sums = StepSums(cost(jnp.stack([before.error, here.error])), problem.by_device(longest))
        guard = None if state.guard is None else state.guard.seeing(surface)
        return here, dataclasses.replace(state, sums=sums, guard=guard)

    def accept(self, problem: Problem, old: Iterate, new: Iterate) -> Iterate:
        """The new iterate if its objective is lower and it has no more folds, otherwise the old surface."""
        state, damped = new.state, new.state.damping
        here, before = new.projection, old.projection
        nets = jnp.stack([damped.origin.control_points, new.surface.control_points])
        objective, after = state.sums.costs + jax.vmap(state.penalty.energy)(nets)
        gain = actual_gain(damped, objective, after)
        longest_move = jnp.max(state.sums.longest_move)
        # With a traced lambda that is none no step is finite, and the loop ends.
        lost = jnp.isnan(state.smoothing)
        good = better = lost | is_no_worse(damped, gain, longest_move)
        guard = state.guard
        if guard is not None:
            good = better & (jnp.sum(guard.folds) <= jnp.sum(old.state.guard.folds))
            time = new.step, problem.tolerances.max_steps
            guard = self.smoothing.after(old.state.guard, guard, better, good, new.surface.order, *time)
        # A step that folds is taken again with more smoothing, not with more damping.
        usual = USUAL_DAMPING if guard is None else GUARDED_DAMPING
        least = jnp.minimum(usual, self.damping)
        assert before.summary is not None
        assert here.summary is not None
        is_free = isinstance(self.border, FreeBorder)
        following = next_damping(damped, objective, here.summary[0], gain, better, least, is_free)
        following = lax.select(better & ~good, damped.damping, following)
        following = jnp.where((new.step == 1) & good, self.damping, following)
        summary = jnp.concatenate([before.summary[:2], here.summary[2:3], np.zeros(1, here.u.dtype)])
        before = dataclasses.replace(before, evaluations=here.evaluations, summary=summary)
        surface, projection = lax.cond(good, lambda: (new.surface, here), lambda: (damped.origin, before))
        damped = DampingState(surface, damped.predicted, following, damped.rejected_steps + ~good)
        state = dataclasses.replace(state, damping=damped, guard=guard)
        return Iterate(surface, projection, state, new.step)

    def move(self, problem: Problem, iterate: Iterate, history: ErrorHistory) -> tuple[Iterate, ErrorHistory]:
        """New knots if it is time, and a step that `accept` decides on once it has been measured."""
        here, state = iterate.projection, iterate.state
        surface, guard = self._refined(problem, iterate)
        damping = state.damping.damping
        net, axes = surface.control_points, surface.axes
        length = loss_length(self.loss, problem, surface.axes, here.error)
        weight = reweighted(self.loss, length, problem.weight, here.error)
        held = held_points(self.border, net.shape, surface.used)
        longest = longest_moves(jnp.asarray(net), self.reach, surface.used)
        if guard is not None:
            assert here.summary is not None
            spacing = jnp.sum(longest * ~held) / (self.reach * jnp.maximum(jnp.sum(~held), 1))
            share, far = guard.at_base(iterate.step, here.summary[0] * problem.diagonal, spacing)
            damping, held = share * damping, held | (guard.held > 0)
        always = problem.diagonal > 0
        pieces = surface.pieces
        feet = (here.u, here.v, weight)
        here_in_rows = (rows_with_influence(pieces, *feet), *feet)
        equations = materialise(always, partial(normal_equations, problem), pieces, *here_in_rows, damping)
        term = DataTerm.of(self.loss, length, problem, here.error)
        equations, term = problem.total((equations, term))
        if guard is None:
            plate = plate_of(state.plate, surface)
            penalty: AbstractPenalty = WeightedPlate(plate, state.smoothing)
        else:
            guard = self.smoothing.beginning(guard, share, far, term)
            penalty = self.smoothing.penalty(guard, surface, problem.diagonal, term)

        def correction_rhs(move: Array) -> Array:
            moves = pieces_on(move, *axes)
            own = materialise(always, partial(second_order_rhs, problem), pieces, moves, *here_in_rows)
            return problem.total(own)

        def solve(penalty: Any, *x: Any) -> tuple[Array, Array]:
            return gauss_newton_step(penalty, correction_rhs, *x)

        second_order = damping < CORRECTED_BELOW
        if guard is not None:
            second_order &= self.smoothing.has_faded(guard)
        args = (penalty, equations, net, held, longest, damping, second_order)
        following, predicted = materialise(always, solve, *args)
        lost = jnp.isnan(state.smoothing)  # a traced lambda that is none
        following = jnp.where(lost, jnp.nan, following)
        damped = DampingState(surface, predicted, damping, state.damping.rejected_steps)
        state = dataclasses.replace(state, damping=damped, penalty=penalty, guard=guard)
        return Iterate(surface.moved_to(following), here, state, iterate.step + 1), history

    def stationarity(
        self, problem: Problem, surface: WorkingSurface, state: OrthogonalState, error: Array
    ) -> StationarityCondition:
        """Half the gradient of F. Factors of RegularSmoothing count as constant, but for those at `least`."""
        length = loss_length(self.loss, problem, surface.axes, error)
        if state.guard is None:
            smoothing = as_smoothing(self.smoothing, error.dtype) * jnp.sum(problem.weight)
            penalty: AbstractPenalty = WeightedPlate(plate_of(state.plate, surface), smoothing)
        else:
            term = DataTerm.of(self.loss, length, problem, error)
            guard = self.smoothing.following_least(state.guard)
            penalty = self.smoothing.penalty(guard, surface, problem.diagonal, term)
        held = held_points(self.border, surface.control_points.shape, surface.used)
        return StationarityCondition(reweighted(self.loss, length, problem.weight, error), held, penalty)

    def _refined(self, problem: Problem, iterate: Iterate) -> tuple[WorkingSurface, FoldGuard | None]:
        """The accepted surface, with new knots if it is time; they change neither it nor its feet."""
        surface, guard = iterate.surface, iterate.state.guard
        if self.insertion is None:
            return surface, guard
        refine = partial(self.insertion, projection=iterate.projection, counted=problem.counted)
        refined = lax.cond(iterate.step > 0, lambda: refine(iterate.step, surface), lambda: surface)
        if guard is not None:
            grown = jnp.any(jnp.asarray(refined.used) > jnp.asarray(surface.used))
            guard = lax.cond(grown, lambda: self.smoothing.renewed(guard, refined), lambda: guard)
        return refined, guard

    def postprocess(
        self, problem: Problem, iterate: Iterate, stopped_early: Array
    ) -> tuple[Iterate, dict[str, Any]]:
        """The iterate as it is; lambda, the integral (10), the last damping and the rejected steps."""
        state, surface = iterate.state, iterate.surface
        stats = {"damping": state.damping.damping, "rejected_steps": state.damping.rejected_steps}
        if state.guard is not None:
            away = self.smoothing.held_back(state.guard, surface, problem, iterate.projection)
            out_of_reach = problem.total(jnp.sum(away, dtype=jnp.int32))
            return iterate, {"points_out_of_reach": out_of_reach, **stats}
        energy = plate_of(state.plate, surface).energy(surface.control_points) * problem.scale**2
        return iterate, {
            "smoothing": as_smoothing(self.smoothing, energy.dtype),
            "bending_energy": energy,
            **stats,
        }
