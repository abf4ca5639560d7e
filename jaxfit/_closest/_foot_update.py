"""`update_feet`: local feet on a surface that has moved, and sums over the points there."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._closest._differentiable_feet import follow_feet
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._foot_states import FOUND, SUMMED_FOUND, FootLimits, FootStates
from jaxfit._closest._iterate_feet import PointSums, iterate_feet
from jaxfit._closest._project import ParameterBounds, in_precision_of, initial_feet
from jaxfit._precision import default_foot_tolerance
from jaxfit._splines._pieces import Pieces
from jaxfit._unrolling import unrolled

FOOT_STEPS = 40  # evaluations of the surface, after which a foot is not found


class FootUpdate(eqx.Module):
    """Feet and the lengths of their residuals, which are 0 for idle points."""

    u: Float[Array, " points"]
    v: Float[Array, " points"]
    error: Float[Array, " points"]
    evaluations: Int[Array, " points"]
    converged: Bool[Array, " points"]


def update_feet(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Float[Array, "d points"],
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    tolerance: Float[Array, ""],
    *,
    idle: Bool[Array, " points"],
    max_steps: Any = FOOT_STEPS,
    single_step: Any = False,
    within: ParameterBounds | None = None,
    sums: PointSums | None = None,
    weight: Float[Array, " points"] | None = None,
) -> tuple[FootUpdate, Any]:
    r"""Local feet of `target` from the last ones (u, v), and the `sums` over the residuals there.

    Parameters
    ----------
    method : Newton() or HuWallner()
    pieces : Pieces
        Those of the surface, `WorkingSurface.pieces`.
    target : array (d, points)
    u, v : array (points,)
        Where the search begins.
    tolerance : array ()
        The largest tangential part of a residual, a length. Rounding is allowed for, so 1e-12 times
        `problem.diagonal` suits both precisions.
    idle : array (points,) of bool
        Points that stay where they are and take no part.
    max_steps : int
        Evaluations of the surface (default 40); a foot not found with these is the best point so far.
    single_step : bool, default False
        Whether every foot takes one step $(\delta u, \delta v)$ only; its residual is the one predicted
        there, $e - R_u \delta u - R_v \delta v$. May be traced, and needs `sums`.
    within : tuple of four arrays (points,), optional
        Bounds of every foot's own: low_u, high_u, low_v, high_v.
    sums : ControlPointSums(), optional
        What is summed over the residuals at the feet.
    weight : array (points,), optional
        How much each point counts in the sums (default 1).

    Returns
    -------
    feet : FootUpdate
        Arrays `u`, `v`, `error` (0 for idle points), `evaluations` and `converged`, each (points,).
    sums : pytree
        What `sums` gives; empty without it.

    Notes
    -----
    Source: the feet of section 4.1 of Kineri, Wang, Lin and Maekawa (2012), with the step of the `method`.

    Examples
    --------
    >>> x, y = np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij")
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> square = jf.WorkingSurface.of(np.stack([x, y, 0 * x], axis=2), knots, knots)
    >>> target, start = jnp.array([[0.25, 3.0], [0.5, 0.5], [2.0, 0.0]]), jnp.array([0.5, 0.5])
    >>> idle, tolerance = jnp.array([False, False]), jnp.asarray(1e-5)
    >>> feet, _ = jf.update_feet(jf.Newton(), square.pieces, target, start, start, tolerance, idle=idle)
    >>> np.round(feet.u, 3).tolist(), np.round(feet.v, 3).tolist(), np.round(feet.error, 3).tolist()
    ([0.25, 1.0], [0.5, 0.5], [2.0, 2.0])
    """
    pieces = in_precision_of(target, pieces)
    if unrolled():
        # A foot's derivative is that of the closest point, so the foot has to be one.
        least = default_foot_tolerance(target.dtype) * jnp.max(jnp.abs(target))
        fixed = lax.stop_gradient((pieces, target, u, v, jnp.minimum(tolerance, least)))
        feet, _ = _found(method, *fixed, idle, max_steps, False, within, None, None)
        here = feet.best_u, feet.best_v
        u, v, error, total = follow_feet(pieces, target, here, (u, v), idle, sums, weight)
        return FootUpdate(u, v, error, feet.steps, feet.converged), total
    given = pieces, target, u, v, tolerance, idle
    feet, found = _found(method, *given, max_steps, single_step, within, sums, weight)
    error = jnp.where(idle, 0.0, jnp.sqrt(jnp.where(idle, 0.0, feet.squared_distance)))
    return FootUpdate(feet.best_u, feet.best_v, error, feet.steps, feet.converged), found


def _found(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Array,
    u: Array,
    v: Array,
    tolerance: Array,
    idle: Array,
    max_steps: Any,
    single_step: Any,
    within: ParameterBounds | None,
    sums: PointSums | None,
    weight: Array | None,
) -> tuple[FootStates, Any]:
    limits = FootLimits.of(tolerance, jnp.max(jnp.abs(target)), max_steps)
    done = FOUND if sums is None else SUMMED_FOUND
    feet, bounds = initial_feet(pieces, u, v, idle, within, done)
    return iterate_feet(method, pieces, target, feet, limits, bounds, sums, weight, single_step)
