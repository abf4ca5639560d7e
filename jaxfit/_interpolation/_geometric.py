"""`GeometricInterpolation`: section 3 of the paper."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._checks import check_kind, check_number, check_switches, is_concrete
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._adjoints import AbstractAdjoint, UnrolledAdjoint
from jaxfit._fit._border import corners
from jaxfit._fit._feet import measure_grid, side_bounds
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._method import AbstractIterativeMethod, Iterate
from jaxfit._fit._method_fields import check_common_fields
from jaxfit._fit._problem import Problem
from jaxfit._fit._result import Fit
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._interpolation._fixed_parameters import (
    AbstractAcceleration,
    FrozenSystem,
    Richardson,
    iterate_frozen,
)
from jaxfit._interpolation._foot_bounds import bounds_between, is_within
from jaxfit._interpolation._geometric_fit import geometric_fit
from jaxfit._interpolation._method import (
    AbstractInterpolation,
    GridProblem,
    Progress,
    finish,
    refuse_normals,
)
from jaxfit._interpolation._per_point_collocation import point_collocation
from jaxfit._interpolation._step_weights import AbstractRepositioning, OptimalRepositioning
from jaxfit._parameters import AbstractParametrisation, ChordLength
from jaxfit._splines import Reflection


class GeometricInterpolationState(eqx.Module):
    """The feet of the next move, and their bounds; the surface with the smallest maximum error so far; feet
    before the first moves, which derivatives replay (NaN where there are none, or where the foot has stayed);
    and the smallest eigenvalue of the collocation matrix, where a choice of the method asks for it.
    """

    feet: Float[Any, "2 points"]
    bounds: Float[Any, "2 2 points"]
    best: WorkingSurface
    projection: FootPoints
    maximum: Float[Any, ""]
    path: Float[Any, "moves 2 points"]
    lowest: Float[Any, ""]


class GeometricInterpolation(AbstractIterativeMethod, AbstractInterpolation):
    r"""Move every control point by the error vector of its own data point, until all vanish.

    The control net starts as the data (12). In every iteration the closest point of each $Q_{ij}$ on the
    surface is found, warm-started, and with $e_{ij} = Q_{ij} - R(\hat u_{ij}, \hat v_{ij})$ (13)

    $$P_{ij} \leftarrow P_{ij} + w_{ij} e_{ij} \quad (14)$$

    except at the four corners, which the surface interpolates from the start. After a few iterations the feet
    hardly move; they are then frozen (section 3.3.1), which makes an iteration a fixed stencil on the net,
    until the errors there meet the tolerance. New closest points then give the exact errors, and if these do
    not meet it, the iteration resumes from them.

    Plain, as in (12)-(14), it is `GeometricInterpolation(repositioning=UnitWeights(), freeze_after=None,
    solve_stalled=False)`: the slowest errors then fall by a factor of about 0.92 an iteration, so 1e-12 of
    the diagonal takes some 200.

    Parameters
    ----------
    parametrisation : ChordLength() or Centripetal()
        Of the grid's rows and columns; its averages give knots (5) and first feet. Centripetal is better
        where the data takes sharp turns.
    repositioning : OptimalRepositioning(), ConstantWeight() or UnitWeights()
        The weights w: equation (27), Lu's (17), or 1.
    freeze_after : int or None
        Iterations with moving feet before they are held; None never holds them.
    acceleration : Richardson() or Chebyshev()
        How moves with frozen feet are made: as they are, or by Chebyshev's semi-iteration, which takes about
        half as many.
    local : bool
        Move only control points whose data point still misses the tolerance on the maximum error (Maekawa et
        al., 2007).
    foot_method : Newton() or HuWallner()
        How feet are brought up to date (default Newton).
    foot_tolerance : float
        To what tangential error, as a fraction of the diagonal.
    keep_borders : bool, default False
        Whether feet of the grid's border points are searched on the border curves only. Otherwise they are
        closest points of the whole surface, as in the paper, and may leave the border a little.
    per_point : bool, default False
        Whether feet start at each point's own parameters in its row and column, as in the paper, rather
        than at the averages. What they converge to is the same unless the surface folds.
    symmetry : Reflection(), optional
        Reflectional symmetry of the surface (section 3.2). Data, parameters and knots are made symmetric
        once, which the iteration keeps: the net is symmetric, and errors are measured to the symmetrised
        data. How far the given points were from symmetric is `Fit.stats["asymmetry"]`: the largest distance
        between a point and the mirror image of its partner, as a fraction of the diagonal. No point is moved
        by more than half of that.
    adjoint : UnrolledAdjoint() or ImplicitAdjoint()
        What derivatives in the data mean: those of the fit as run, or those at held parameters.
    stall_window, stall_gain : int, float
        The fit stops as stalled when neither error has fallen by the share `stall_gain` within
        `stall_window` iterations, as it does at rounding level. It then returns the best surface whose
        closest points it has computed, or that of `solve_stalled`.
    solve_stalled : bool, default True
        Whether a fit that stalls above rounding level, or whose surface folds, makes one last step: it
        solves the linear system at the parameters of the grid, and returns its solution, that of
        `StandardInterpolation`, where that is closer, or folds less. So that this comes soon, `stall_gain` is
        then at least 0.75: a fit that would need more than some 600 iterations counts as stalled. Inside
        transformations (`jit`, `grad`, `vmap`) nothing is solved, and such a fit ends as it is; use
        `StandardInterpolation` there.

    Raises
    ------
    ValueError
        If a number is out of range.
    TypeError
        If a choice is not one of its kind, or an option is no number.

    Notes
    -----
    It converges where the eigenvalues of the collocation matrix at the feet, times the weights, lie between
    0 and 2: fast for low orders, slowly from order 6 on. So that feet keep the order of their points, a foot
    stays where it was if the closest point lies beyond the middle between its own first parameters and those
    of its neighbours in the grid. Even so the iteration may stall where neighbouring rows of the grid differ
    by orders of magnitude in distance or length, or where points repeat.

    `Fit.stats["solved"]` tells whether the linear system gave the surface. It counts as one iteration.

    Examples
    --------
    >>> import jaxfit as jf
    >>> method = jf.GeometricInterpolation(acceleration=jf.Chebyshev())
    >>> method.repositioning, method.freeze_after, method.parametrisation
    (OptimalRepositioning(), 2, ChordLength())
    """

    parametrisation: AbstractParametrisation = ChordLength()
    repositioning: AbstractRepositioning = OptimalRepositioning()
    freeze_after: int | None = 2
    acceleration: AbstractAcceleration = Richardson()
    local: bool = False
    foot_method: AbstractFootMethod = Newton()
    foot_tolerance: float = 1e-13
    keep_borders: bool = False
    per_point: bool = False
    symmetry: Reflection | None = None
    adjoint: AbstractAdjoint = UnrolledAdjoint()
    stall_window: int = 40
    stall_gain: float = 0.1
    solve_stalled: bool = True

    def __check_init__(self) -> None:
        for name, kind, example in (
            ("parametrisation", AbstractParametrisation, "ChordLength() or Centripetal()"),
            (
                "repositioning",
                AbstractRepositioning,
                "OptimalRepositioning(), UnitWeights() or ConstantWeight()",
            ),
            ("acceleration", AbstractAcceleration, "Richardson() or Chebyshev()"),
            ("symmetry", (Reflection, type(None)), "Reflection()"),
            ("adjoint", AbstractAdjoint, "UnrolledAdjoint()"),
        ):
            check_kind(name, getattr(self, name), kind, example)
        check_common_fields(self)
        check_switches(self, ("local", "keep_borders", "per_point", "solve_stalled"))
        if self.freeze_after is not None:
            check_number("freeze_after", self.freeze_after, 0, whole=True)

    @staticmethod
    def check_normals(normals: Any, grid: Any, order: tuple[int, int]) -> Any:
        """None can be met."""
        refuse_normals("GeometricInterpolation", normals)

    def fit(self, problem: GridProblem, progress: Progress | None) -> Fit:
        """Parameters and knots, and the loop."""
        return finish(*geometric_fit(self, problem, progress))

    @property
    def needs_spectrum(self) -> bool:
        """Whether the smallest eigenvalue of the collocation matrix plays a part."""
        return self.repositioning.needs_spectrum or self.acceleration.needs_spectrum

    @property
    def stall_since(self) -> int:
        """The first iteration."""
        return 0

    @property
    def finds_feet(self) -> bool:
        """True: feet are found in every iteration."""
        return True

    def init(
        self, problem: Problem, surface: WorkingSurface, projection: FootPoints
    ) -> tuple[WorkingSurface, GeometricInterpolationState]:
        """Nothing is known yet; whoever needs the eigenvalue sets it."""
        xp: Any = np if is_concrete(problem) else jnp
        far = xp.asarray(np.inf, problem.target.dtype)
        moves = self.adjoint.moves(self.freeze_after)
        path = np.full((0 if moves is None else moves + 1, 2, problem.target.shape[1]), np.nan, far.dtype)
        feet = xp.stack([projection.u, projection.v])
        bounds = bounds_between(projection.u, projection.v, *surface.control_points.shape[:2])
        return surface, GeometricInterpolationState(
            feet, bounds, surface, projection, far, path, xp.ones_like(far)
        )

    def measure(
        self, problem: Problem, iterate: Iterate, exact: Array
    ) -> tuple[FootPoints, GeometricInterpolationState]:
        """Closest points from the last feet, which stay where a closest point is out of bounds."""
        surface = iterate.surface
        state: GeometricInterpolationState = iterate.state
        nu, nv = surface.control_points.shape[:2]
        held = corners(nu, nv).reshape(-1)
        within = side_bounds(surface.axes, nu, nv) if self.keep_borders else None
        here = measure_grid(
            self.foot_method,
            problem,
            surface.pieces,
            dataclasses.replace(iterate.projection, u=state.feet[0], v=state.feet[1]),
            self.foot_tolerance,
            held,
            within,
        )
        feet = jnp.stack([here.u, here.v])
        within = is_within(feet, state.bounds)
        maximum, path = jnp.max(here.error), state.path
        if path.shape[0]:
            path = path.at[iterate.step].set(jnp.where(within, feet, jnp.nan), mode="drop")
        feet = jnp.where(within, feet, state.feet)
        parts = ((surface, here, maximum), (state.best, state.projection, state.maximum))
        *best, least = jax.tree.map(lambda x, y: lax.select(maximum < state.maximum, x, y), *parts)
        return here, GeometricInterpolationState(
            feet, state.bounds, best[0], best[1], least, path, state.lowest
        )

    def accept(self, problem: Problem, old: Iterate, new: Iterate) -> Iterate:
        """The new iterate: errors may rise on the way."""
        return new

    def move(self, problem: Problem, iterate: Iterate, history: ErrorHistory) -> tuple[Iterate, ErrorHistory]:
        """Equations (13) and (14) once, or as often as the frozen feet allow."""
        surface, here = iterate.surface, iterate.projection
        nu, nv = surface.control_points.shape[:2]
        target = problem.target.reshape(-1, nu, nv)
        collocation = point_collocation(surface.axes, *iterate.state.feet.reshape(2, nu, nv))
        lowest = iterate.state.lowest
        weight = self.repositioning.weights(collocation, lowest)
        system = FrozenSystem(collocation, target, weight, corners(nu, nv), lowest, problem.diagonal)
        if self.freeze_after is None:
            most = jnp.ones_like(iterate.step)
        else:
            most = jnp.where(iterate.step < self.freeze_after, 1, problem.tolerances.max_steps)
        net, step, history = iterate_frozen(
            self, problem.tolerances, system, most, surface.control_points, iterate.step, history
        )
        return Iterate(surface.moved_to(net), here, iterate.state, step), history

    def postprocess(
        self, problem: Problem, iterate: Iterate, stopped_early: Array
    ) -> tuple[Iterate, dict[str, Any]]:
        """The best surface, if the errors have stopped falling before the end."""
        state: GeometricInterpolationState = iterate.state
        found = (state.best, state.projection)
        early = stopped_early & jnp.isfinite(state.maximum)
        surface, projection = jax.tree.map(
            lambda x, y: lax.select(early, x, y), found, (iterate.surface, iterate.projection)
        )
        return Iterate(surface, projection, state, iterate.step), {}
