"""`GeometricApproximation`: Algorithm 1 of the paper (section 4.1)."""

from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._approximation._control_point_sums import ControlPointSums, WeightedErrors
from jaxfit._approximation._foot_extrapolation import FootExtrapolation
from jaxfit._approximation._knot_insertion import KnotInsertion, check_insertion, room_for
from jaxfit._approximation._local_region import local_region
from jaxfit._approximation._losses import check_loss, loss_length, reweighted
from jaxfit._approximation._nesterov import LARGEST_RELAXATION, Momentum, Nesterov, zero_momentum
from jaxfit._approximation._net_fairing import Fairing
from jaxfit._checks import Scalar, check_kind, check_number, check_switches, is_concrete
from jaxfit._closest import AbstractFootMethod, FootUpdate, HuWallner, Newton, update_feet
from jaxfit._fit._border import AbstractBorder, FixedBorder, check_border, held_points
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._method import AbstractIterativeMethod, Iterate
from jaxfit._fit._method_fields import check_common_fields
from jaxfit._fit._problem import Problem
from jaxfit._fit._stationarity_condition import StationarityCondition
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._splines._pieces import Pieces
from jaxfit._unrolling import unrolled
from jaxfit._varying import as_varying


class GeometricState(eqx.Module):
    """What the method keeps from one iteration to the next."""

    sums: Float[Any, "nu nv c"]  # of Algorithm 1, at the last projection
    momentum: Momentum | None  # if steps are accelerated
    exceeded: Bool[Any, " points"] | None  # in local mode: points whose error ever exceeded the tolerance
    extrapolation: FootExtrapolation | None  # the last step of converged feet, from which the next ones start


class GeometricApproximation(AbstractIterativeMethod):
    r"""Move every control point by the weighted mean of the error vectors around it.

    With the foot $(u_k, v_k)$ of every point and its error vector $e_k = Q_k - R(u_k, v_k)$,

    $$P_{ij} \leftarrow P_{ij} + \frac{\sum_k w_k N_i(u_k) N_j(v_k)\, e_k}{\sum_k w_k N_i(u_k) N_j(v_k)},$$

    then new feet, which start from the last ones, and so on (Algorithm 1). A control point that influences no
    data point does not move. With the feet held this converges to the least-squares solution at their
    parameters (section 4.2). Coarse features converge within a few iterations, fine ones slowly.

    Parameters
    ----------
    border : FixedBorder(), FixedCorners(), FreeBorder() or FixedSides(...)
        Which control points on the border of the net stay (default all of them, section 2.3 of the paper).
    relaxation : float
        Factor on the mean (default 1.3; 1 in the paper). The iteration converges below 4/3, or below 2
        without acceleration, since its largest eigenvalue with the feet held is 1.
    acceleration : Nesterov() or None
        Momentum (default Nesterov's; None, plain steps, in the paper). Nesterov's takes a third of the
        iterations of plain steps, or fewer where many are needed.
    single_step : bool
        Whether feet take one step in each iteration instead of converging (default True; False in the paper).
        Errors are then predicted to first order. The first and the last surface are measured exactly, at
        converged feet. With False, feet converge in every iteration. They start from an extrapolation of
        their last move; a Taylor bound certifies nearly all of them after one evaluation, and `foot_method`
        finds the others.
    insertion : KnotInsertion(), optional
        New knots every few iterations where the errors are greatest (default none: the net keeps its size).
    fairing : Fairing(), optional
        Laplacian fairing of the net every few iterations (section 4.3; default none).
    local : bool, default False
        Whether only control points move that influence a point whose error ever exceeded the tolerance
        (section 4.1). That is the tolerance on the maximum error or, where that is met or not given, the one
        on the average error. The other control points keep every bit. Points whose cell did not move are not
        projected again.
    loss : Huber(), Tukey() or GemanMcClure(), optional
        For data with outliers: points are reweighted in each iteration (default least squares).
    foot_method : Newton() or HuWallner()
        The step towards a foot (default Newton; HuWallner in the paper).
    foot_tolerance : float
        The largest tangential residual of a converged foot, as a fraction of the diagonal (default 1e-12).
        The paper's results do not depend on it between 1e-5 and 1e-12.
    stall_window, stall_gain : int, float
        The fit stops as stalled when neither error has fallen by the share `stall_gain` within
        `stall_window` iterations (default 2e-3 within 40).

    Raises
    ------
    ValueError
        If `relaxation` is not positive or too large for convergence, `stall_window` is no multiple of the
        iterations from one fairing to the next, or a number is out of range.
    TypeError
        If a field is of the wrong kind.

    Notes
    -----
    Section 4 of Kineri, Wang, Lin and Maekawa (2012).

    Examples
    --------
    >>> method = jf.GeometricApproximation()
    >>> method.relaxation, method.acceleration, method.single_step
    (1.3, Nesterov(), True)
    >>> method = jf.GeometricApproximation.paper(fairing=None)
    >>> method.relaxation, method.single_step, method.insertion.every, method.fairing
    (1.0, False, 40, None)
    """

    border: AbstractBorder = FixedBorder()
    relaxation: Scalar = 1.3
    acceleration: Nesterov | None = Nesterov()
    single_step: bool = True
    insertion: KnotInsertion | None = None
    fairing: Fairing | None = None
    local: bool = False
    loss: Any = None
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: Scalar = 1e-12
    stall_window: int = 40
    stall_gain: Scalar = 2e-3

    @classmethod
    def paper(cls, **changes: Any) -> "GeometricApproximation":
        """The method of section 4 as printed: plain steps, converged feet, fairing, and new knots.

        `changes` override single fields.
        """
        steps = dict(relaxation=1.0, acceleration=None, single_step=False)
        feet = dict(foot_method=HuWallner(), foot_tolerance=1e-8)
        return cls(**(steps | feet | dict(insertion=KnotInsertion(), fairing=Fairing()) | changes))

    @property
    def stall_since(self) -> int:
        """The first fairing: the errors of a base surface that has not been faired may be lower."""
        return 0 if self.fairing is None else self.fairing.every

    def __check_init__(self) -> None:
        check_loss(self.loss)
        check_insertion(self.insertion)
        for name, kind in (("fairing", Fairing), ("acceleration", Nesterov)):
            check_kind(name, getattr(self, name), kind | None, f"{kind.__name__}()")
        check_border(self.border)
        check_common_fields(self)
        check_switches(self, ("single_step", "local"))
        check_number("relaxation", self.relaxation, 0.0)
        most, such = (2, "") if self.acceleration is None else (LARGEST_RELAXATION, " accelerated")
        if is_concrete(self.relaxation) and not 0 < self.relaxation < most:
            raise ValueError(
                f"relaxation must lie between 0 and {most:.4g}, where the{such} iteration converges, but is "
                f"{self.relaxation!r}; pass 1, as in the paper, or 1.3."
            )
        if self.fairing is not None and self.stall_window % self.fairing.every:
            raise ValueError(
                f"stall_window must be a multiple of the {self.fairing.every} iterations from one fairing to "
                f"the next, but is {self.stall_window}; change one of them."
            )

    @property
    def finds_feet(self) -> bool:
        """True: feet are found in every iteration."""
        return True

    def init(
        self, problem: Problem, surface: WorkingSurface, projection: FootPoints
    ) -> tuple[WorkingSurface, GeometricState]:
        """A surface with room for new knots, and no momentum."""
        surface = room_for(self.insertion, surface, problem.tolerances.max_steps)
        net = surface.control_points
        xp: Any = np if is_concrete(net, projection) else jnp
        sums = xp.zeros((*net.shape[:2], net.shape[2] + 1), net.dtype)
        momentum = None if self.acceleration is None else zero_momentum(net)
        extrapolation = FootExtrapolation.initial(projection.u) if self._extrapolates else None
        exceeded = projection.converged if self.local else None
        return surface, GeometricState(sums, momentum, exceeded, extrapolation)

    @property
    def _extrapolates(self) -> bool:
        """Whether converging feet start ahead. Weights of a loss need errors at the feet themselves."""
        return not self.single_step and self.loss is None

    def measure(self, problem: Problem, iterate: Iterate, exact: Array) -> tuple[FootPoints, GeometricState]:
        """New feet, converged or one step on, and the sums of Algorithm 1 there."""
        state: GeometricState = iterate.state
        pieces, before = iterate.surface.pieces, iterate.projection
        resting = ~jnp.asarray(problem.real)
        if self.local:
            assert state.exceeded is not None
            region = local_region(pieces, before.u, before.v, state.exceeded)
            resting = resting | (~region.points & ~exact)
        feet, sums = self._feet(problem, pieces, state, before, resting, exact)
        error = jnp.where(resting, before.error, feet.error)
        extrapolation = state.extrapolation
        if extrapolation is not None:
            extrapolation = extrapolation.after(jnp.stack([feet.u - before.u, feet.v - before.v]))
        length = loss_length(self.loss, problem, iterate.surface.axes, error)
        weight = reweighted(self.loss, length, problem.weight, error)
        active = jnp.sum((weight > 0) & ~resting, dtype=jnp.int32)
        exceeded = state.exceeded
        if self.local:
            errors = jnp.where(problem.counted, error, 0.0) / problem.diagonal
            exceeded = exceeded | (errors > _local_tolerance(problem, jnp.max(errors)))
            # Sums are complete where all points were projected, or all that influence the control point.
            after = local_region(pieces, feet.u, feet.v, exceeded)
            complete = jnp.where(exact, after.control_points, region.control_points)
            sums = jnp.where(complete[..., None], sums, 0.0)
        certain = exact | (not self.single_step)
        converged = jnp.where(certain, feet.converged, before.converged)
        here = FootPoints(feet.u, feet.v, error, feet.evaluations, converged, active, certain)
        return here, GeometricState(sums, state.momentum, exceeded, extrapolation)

    def _feet(
        self,
        problem: Problem,
        pieces: Pieces,
        state: GeometricState,
        before: FootPoints,
        resting: Bool[Array, " points"],
        exact: Array,
    ) -> tuple[FootUpdate, Float[Array, "nu nv c"]]:
        """Feet and sums. A loss weighs points by the errors of the iteration before. Where these are not
        errors at feet, or there are none, feet are updated twice.
        """
        u, v = before.u, before.v
        if state.extrapolation is not None:
            u, v = state.extrapolation.predict((pieces.axis_u, pieces.axis_v), u, v)

        def update(u: Array, v: Array, error: Array) -> tuple[FootUpdate, WeightedErrors]:
            axes = pieces.axis_u, pieces.axis_v
            weigh = partial(reweighted, self.loss, loss_length(self.loss, problem, axes, error))
            return update_feet(
                self.foot_method,
                pieces,
                problem.target,
                u,
                v,
                self.foot_tolerance * problem.diagonal,
                idle=resting,
                single_step=~exact if self.single_step else False,
                sums=ControlPointSums(None if self.loss is None else weigh),
                weight=problem.weight,
            )

        if self.loss is None:
            feet, sums = update(u, v, before.error)
            return feet, sums.sums

        def again(passes: Any) -> Any:
            number, feet, _ = passes
            new, sums = update(feet.u, feet.v, feet.error)
            steps = jnp.where((number > 0) & certain, feet.evaluations, new.evaluations)
            return number + 1, eqx.tree_at(lambda f: f.evaluations, new, steps), sums.sums

        if unrolled():  # converged feet, once for the weights and once for the sums
            feet, _ = update(u, v, before.error)
            feet, sums = update(feet.u, feet.v, feet.error)
            return feet, sums.sums
        certain = exact | (not self.single_step)
        first = FootUpdate(u, v, before.error, before.evaluations, before.converged)
        begin = (jnp.where(certain, 0, 1), first, state.sums)
        _, feet, total = lax.while_loop(lambda passes: passes[0] < 2, again, begin)
        return feet, total

    def accept(self, problem: Problem, old: Iterate, new: Iterate) -> Iterate:
        """The new iterate: errors may rise on the way."""
        return new

    def move(self, problem: Problem, iterate: Iterate, history: ErrorHistory) -> tuple[Iterate, ErrorHistory]:
        """One step of Algorithm 1, then fairing and new knots if it is time."""
        surface, state, step = iterate.surface, iterate.state, iterate.step + 1
        net, momentum = surface.control_points, state.momentum
        held = held_points(self.border, net.shape, surface.used)
        reached = jnp.where(held[..., None], net, net + self.relaxation * WeightedErrors(state.sums).means)
        changes = [x.every for x in (self.fairing, self.insertion) if x is not None]
        changed = jnp.any(step % np.asarray(changes, np.int32) == 0)
        moved = reached
        if self.acceleration is not None:
            beyond, momentum = self.acceleration(momentum, reached, history.has_risen(iterate.step))
            moved = jnp.where(changed, reached, beyond)
        if self.fairing is not None:
            outside = held_points(FixedBorder(), net.shape, surface.used)
            moved = jnp.where(step % self.fairing.every == 0, self.fairing(moved, outside), moved)
        surface = surface.moved_to(moved)
        if self.insertion is not None:
            surface = self.insertion(step, surface, iterate.projection, problem.counted)
        if momentum is not None:
            rest = as_varying(zero_momentum(surface.control_points), momentum)
            momentum = lax.cond(changed, lambda: rest, lambda: momentum)
        state = GeometricState(state.sums, momentum, state.exceeded, state.extrapolation)
        return Iterate(surface, iterate.projection, state, step), history

    def stationarity(
        self, problem: Problem, surface: WorkingSurface, state: GeometricState, error: Array
    ) -> StationarityCondition:
        """The weighted means around all control points that move vanish."""
        if self.fairing is not None:
            raise TypeError(
                "a fit with fairing has no derivative, since its surfaces do not come to rest; pass "
                "fairing=None."
            )
        if self.local:
            raise TypeError(
                "a fit with local=True has no derivative, since some control points stay where they are; "
                "pass local=False."
            )
        length = loss_length(self.loss, problem, surface.axes, error)
        weight = reweighted(self.loss, length, problem.weight, error)
        held = held_points(self.border, surface.control_points.shape, surface.used)
        return StationarityCondition(weight, held)

    def postprocess(
        self, problem: Problem, iterate: Iterate, stopped_early: Array
    ) -> tuple[Iterate, dict[str, Any]]:
        """The iterate as it is, and no statistics."""
        return iterate, {}


def _local_tolerance(problem: Problem, maximum: Array) -> Array:
    """The tolerance that local mode works towards."""
    goal = problem.tolerances
    return jnp.where(maximum <= goal.maximum, goal.average, goal.maximum)
