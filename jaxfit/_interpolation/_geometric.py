"""Geometric interpolation of grids: section 3 of the paper."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from jaxfit._checks import check_kind, check_number
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._loop import AbstractIterativeMethod, Limits, Measured, Turn
from jaxfit._fit._measure import border, measure_feet, side_bounds
from jaxfit._interpolation._fixed_parameters import AbstractAcceleration, Richardson, System, iterate_frozen
from jaxfit._interpolation._repositioning import AbstractRepositioning, OptimalRepositioning
from jaxfit._interpolation._point_collocation import point_collocation
from jaxfit._interpolation._adjoints import AbstractAdjoint, UnrolledAdjoint
from jaxfit._parameters import AbstractParametrisation, ChordLength
from jaxfit._splines import Reflection
from jaxfit._splines._pieces import Pieces


class GeometricInterpolation(AbstractIterativeMethod):
    r"""Move every control point by the error vector of its own data point, until all vanish.

    The control net starts as the data (12). In every iteration the closest point of each $Q_{ij}$ on the
    surface is found, warm-started, and with $e_{ij} = Q_{ij} - R(\hat u_{ij}, \hat v_{ij})$ (13)

    $$P_{ij} \leftarrow P_{ij} + w_{ij} e_{ij} \quad (14)$$

    except at the four corners, which the surface interpolates from the start. After a few iterations the feet
    hardly move; they are then frozen (section 3.3.1), which makes an iteration a fixed stencil on the net,
    until the errors there meet the tolerance. New closest points then give the exact errors, and if these do
    not meet it, the iteration resumes from them.

    Plain, as in (12)-(14), it is `GeometricInterpolation(repositioning=UnitWeights(), freeze_after=None)`:
    the slowest errors then fall by a factor of about 0.92 an iteration, so 1e-12 of the diagonal takes some
    200.

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
        Whether feet of the grid's border points are looked for on the border curves only. Otherwise they are
        closest points of the whole surface, as in the paper, and may leave the border a little.
    per_point : bool, default False
        Whether feet start at each point's own parameters in its row and column, as in the paper, rather
        than at the averages. What they converge to is the same unless the surface folds.
    symmetry : Reflection(), optional
        Reflectional symmetry of the surface (section 3.2). Data, parameters and knots are made symmetric
        once, which the iteration keeps: the fit meets the symmetrised data, with a symmetric net.
    adjoint : UnrolledAdjoint() or ImplicitAdjoint()
        What derivatives in the data mean: those of the fit as run, or those at held parameters.
    stall_window, stall_gain : int, float
        The fit stops as stalled when neither error has fallen by the share `stall_gain` within
        `stall_window` iterations, as it does at rounding level. It then returns the best surface whose
        closest points it has computed.

    Notes
    -----
    It converges where the eigenvalues of the collocation matrix at the feet, times the weights, lie between
    0 and 2: fast for low orders, slowly from order 6 on. It may not where rows of the grid differ so much
    that averaged knots suit none of them, or where points repeat; `StandardInterpolation` always has a
    solution.
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

    keeps_best: ClassVar[bool] = True

    def __check_init__(self) -> None:
        for name, kind, example in (
            ("parametrisation", AbstractParametrisation, "ChordLength()"),
            ("repositioning", AbstractRepositioning, "OptimalRepositioning()"),
            ("acceleration", AbstractAcceleration, "Richardson()"),
            ("foot_method", AbstractFootMethod, "Newton()"),
            ("symmetry", (Reflection, type(None)), "Reflection()"),
            ("adjoint", AbstractAdjoint, "UnrolledAdjoint()"),
        ):
            check_kind(name, getattr(self, name), kind, example)
        if self.freeze_after is not None:
            check_number("freeze_after", self.freeze_after, 0, whole=True)

    @property
    def needs_spectrum(self) -> bool:
        """Whether the smallest eigenvalue of the collocation matrix plays a part."""
        return self.repositioning.needs_spectrum or self.acceleration.needs_spectrum

    def move(self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, turn: Turn) -> Turn:
        """Equations (13) and (14) once, or as often as the frozen feet allow."""
        nu, nv, _ = turn.net.shape
        target = problem.target.reshape(-1, nu, nv)
        axes = (pieces.axis_u, pieces.axis_v)
        collocation = point_collocation(axes, measured.u.reshape(nu, nv), measured.v.reshape(nu, nv))
        held = border(nu, nv, corners_only=True)
        lowest = jnp.ones_like(problem.diagonal) if problem.lowest is None else problem.lowest
        weight = self.repositioning.weights(collocation, lowest)
        system = System(collocation, target, weight, held, lowest, problem.diagonal)
        if self.freeze_after is None:
            most = jnp.ones_like(turn.step)
        else:
            most = jnp.where(turn.step < self.freeze_after, 1, limits.max_steps)
        return iterate_frozen(self, limits, system, most, turn)

    def measure(
        self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, exact: Array
    ) -> Measured:
        """Closest points from the last ones."""
        nu, nv = (x.cells + k - 1 for x, k in zip((pieces.axis_u, pieces.axis_v), pieces.order, strict=True))
        corners = border(nu, nv, corners_only=True).reshape(-1)
        within = side_bounds((pieces.axis_u, pieces.axis_v), nu, nv) if self.keep_borders else None
        return measure_feet(self.foot_method, problem, pieces, measured, corners, True, within)
