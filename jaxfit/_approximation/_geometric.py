"""Geometric approximation of scattered points: Algorithm 1 of the paper (section 4.1)."""

from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxfit._approximation._control_point_sums import ControlPointSums, WeightedErrors
from jaxfit._approximation._fairing import Fairing
from jaxfit._approximation._knot_insertion import KnotInsertion, check_insertion
from jaxfit._approximation._local_region import region_of
from jaxfit._approximation._losses import check_loss, loss_length, reweighted
from jaxfit._approximation._nesterov import LARGEST_RELAXATION, Nesterov, at_rest
from jaxfit._checks import check_kind, check_number, check_switches
from jaxfit._closest import AbstractFootMethod, FootUpdate, HuWallner, Newton, update_feet
from jaxfit._fit._loop import AbstractIterativeMethod, Limits, Measured, Turn
from jaxfit._fit._measure import border_on
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
        How far control points follow, as a multiple of the mean: 1.3 by default, 1 in the paper. Safe below
        4/3, or 2 without acceleration, since the largest eigenvalue of the iteration with feet held is 1.
    acceleration : Nesterov() or None
        Momentum, by default Nesterov's, which takes a third of the iterations that the paper's plain steps
        (None) do, and fewer still where many are needed.
    foresee : bool
        Whether feet take one step in each iteration, the residual there being foreseen to first order, rather
        than converge (default True; False in the paper). The first and the last surface are measured at
        converged feet all the same. Feet that converge start ahead by most of their last move, and one
        evaluation is enough for those that are found on the second-order Taylor polynomial there and that a
        bound on the third derivatives proves to be within the tolerance: nearly all. `foot_method` finds the
        others.
    insertion : KnotInsertion(), optional
        New knots every few iterations where the errors are greatest; none by default, so that the net stays
        as it is given.
    fairing : Fairing(), optional
        Laplacian fairing of the net every few iterations (section 4.3); none by default.
    local : bool, default False
        Go on only where the error exceeds the tolerance on the maximum error, or where that is met or not
        given, the tolerance on the average error (section 4.1): control points move that have influence on a
        point which has been so far away, now or before; the others stay to the last bit, and points that do
        not feel the move rest.
    loss : Huber(), Tukey() or GemanMcClure(), optional
        For points with outliers, which are weighed anew in each iteration; least squares by default.
    foot_method : Newton() or HuWallner()
        How feet are brought up to date (default Newton; HuWallner in the paper).
    foot_tolerance : float
        To what tangential error, as a fraction of the diagonal. The paper's results do not depend on it
        between 1e-5 and 1e-12.
    stall_window, stall_gain : int, float
        The fit stops as stalled when neither error has fallen by the share `stall_gain` within
        `stall_window` iterations.
    """

    fixed_boundary: bool = True
    relaxation: float = 1.3
    acceleration: Nesterov | None = Nesterov()
    foresee: bool = True
    insertion: KnotInsertion | None = None
    fairing: Fairing | None = None
    local: bool = False
    loss: Any = None
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: float = 1e-12
    stall_window: int = 40
    stall_gain: float = 2e-3

    counts: ClassVar[bool] = True
    gathers: ClassVar[bool] = True

    @classmethod
    def paper(cls, **changes: Any) -> "GeometricApproximation":
        """Section 4 as printed: plain steps, converged feet, fairing, and new knots.

        `changes` are fields to set otherwise.
        """
        steps = dict(relaxation=1.0, acceleration=None, foresee=False)
        feet = dict(foot_method=HuWallner(), foot_tolerance=1e-8)
        return cls(**(steps | feet | dict(insertion=KnotInsertion(), fairing=Fairing()) | changes))

    @property
    def foresees(self) -> bool:
        """Whether feet between the first surface and the last need not have converged."""
        return self.foresee

    @property
    def comparable_since(self) -> int:
        """From the first fairing on: a base surface that has not been faired may be nearer."""
        return 0 if self.fairing is None else self.fairing.every

    @property
    def glides(self) -> bool:
        """Whether there is momentum."""
        return self.acceleration is not None

    @property
    def leads(self) -> bool:
        """Whether feet start from where their last move leads them."""
        return not self.foresee and self.loss is None  # else weights follow from errors, and these come first

    @property
    def marks(self) -> bool:
        """Whether points that are too far away are remembered."""
        return self.local

    def __check_init__(self) -> None:
        check_loss(self.loss)
        check_insertion(self.insertion)
        for name, kind in (("fairing", Fairing), ("acceleration", Nesterov)):
            if getattr(self, name) is not None:
                check_kind(name, getattr(self, name), kind, f"{kind.__name__}()")
        check_switches(self, ("fixed_boundary", "foresee", "local"))
        check_number("relaxation", self.relaxation, 0.0)
        most, such = (2, "") if self.acceleration is None else (LARGEST_RELAXATION, " accelerated")
        if not 0 < self.relaxation < most:
            raise ValueError(
                f"relaxation must lie between 0 and {most:.4g}, where the{such} iteration converges, but is "
                f"{self.relaxation!r}; pass 1, as in the paper, or 1.3."
            )
        if self.fairing is not None and self.stall_window % self.fairing.every:
            raise ValueError(
                f"stall_window must be a multiple of the {self.fairing.every} iterations from one fairing to "
                f"the next, but is {self.stall_window}; change one of them."
            )

    def move(self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, turn: Turn) -> Turn:
        """One step of Algorithm 1, fairing, and new knots."""
        assert measured.pulls is not None
        net, growth = turn.net, turn.growth
        axes = (pieces.axis_u, pieces.axis_v)
        held = border_on(axes, net.shape, corners_only=not self.fixed_boundary)
        reached = jnp.where(held[..., None], net, net + self.relaxation * measured.pulls.means)
        step, moved, momentum = turn.step + 1, reached, turn.momentum
        changes = [x.every for x in (self.fairing, self.insertion) if x is not None]
        changed = jnp.any(step % np.asarray(changes, np.int32) == 0)
        if self.acceleration is not None and momentum is not None:
            beyond, momentum = self.acceleration(momentum, reached, turn.records.has_risen(turn.step))
            moved = jnp.where(changed, reached, beyond)
        if self.fairing is not None:
            outside = border_on(axes, net.shape, corners_only=False)
            moved = jnp.where(step % self.fairing.every == 0, self.fairing(moved, outside), moved)
        if self.insertion is not None and growth is not None:
            moved, growth = self.insertion(step, moved, growth, measured, problem.padding > 0)
        if momentum is not None:
            momentum = lax.cond(changed, lambda: at_rest(moved), lambda: momentum)
        return Turn(moved, step, turn.records, growth, momentum=momentum)

    def measure(
        self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, exact: Array
    ) -> Measured:
        """Feet from the last ones, converged on the new surface or one step on, and how they pull."""
        idle = problem.padding <= 0
        resting = idle
        if self.local:
            assert measured.poor is not None
            before = region_of(pieces, measured.u, measured.v, measured.poor)
            resting = idle | (~before.alive & ~exact)

        tolerance = problem.foot_tolerance * problem.diagonal
        single = ~exact if self.foresees else False
        u, v, ahead = measured.u, measured.v, measured.ahead
        if ahead is not None:
            u, v = ahead.predict((pieces.axis_u, pieces.axis_v), u, v)

        def looked(u: Array, v: Array, error: Array) -> tuple[Any, WeightedErrors]:
            weigh = partial(reweighted, self.loss, loss_length(self.loss, problem, error))
            sums = ControlPointSums(None if self.loss is None else weigh)
            return update_feet(
                self.foot_method, pieces, problem.target, u, v, tolerance,
                idle=resting, single_step=single, sums=sums, weight=problem.weight,
            )  # fmt: skip

        if self.loss is None:
            feet, pulls = looked(u, v, measured.error)
        else:
            # Weights follow from errors: those at converged feet, so these are looked at twice, or else
            # those of the iteration before.
            none = FootUpdate(u, v, measured.error, measured.steps, measured.found)
            begin = (
                jnp.where(exact | (not self.foresees), 0, 1),
                none,
                jax.tree.map(jnp.zeros_like, measured.pulls),
            )

            def look(carry: Any) -> Any:
                number, feet, _ = carry
                again, pulls = looked(feet.u, feet.v, feet.error)
                steps = jnp.where(number > 0, feet.evaluations, again.evaluations)
                steps = steps if not self.foresees else jnp.where(exact, steps, again.evaluations)
                return number + 1, eqx.tree_at(lambda f: f.evaluations, again, steps), pulls

            feet, pulls = lax.while_loop(lambda carry: carry[0] < 2, look, begin)[1:]
        error = jnp.where(resting, measured.error, feet.error)
        found = feet.converged if single is False else jnp.where(exact, feet.converged, measured.found)
        if ahead is not None:
            ahead = ahead.after(jnp.stack([feet.u - measured.u, feet.v - measured.v]))
        here = Measured(feet.u, feet.v, error, feet.evaluations, found, ahead=ahead)
        weight = problem.weight
        if self.loss is not None:
            weight = reweighted(self.loss, loss_length(self.loss, problem, error), weight, error)
        active = jnp.sum((weight > 0) & ~resting, dtype=jnp.int32)
        poor = None
        if self.local:
            errors = jnp.where(idle, 0.0, here.error) / problem.diagonal
            poor = measured.poor | (errors > _threshold(limits, jnp.max(errors)))
            # Sums are complete where all points were looked at, or those that feel what was touched before.
            after = region_of(pieces, here.u, here.v, poor)
            touched = jnp.where(exact, after.touched, before.touched)
            pulls = WeightedErrors(jnp.where(touched[..., None], pulls.sums, 0.0))
        return Measured(here.u, here.v, here.error, here.steps, here.found, active, pulls, poor, here.ahead)


def _threshold(limits: Limits, maximum: Array) -> Array:
    """The error beyond which a point is poor."""
    return jnp.where(maximum <= limits.maximum, limits.average, limits.maximum)
