"""Projects the points of a problem onto a surface: clouds with `update_feet`, grids with `project`."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxfit._closest import FOOT_STEPS, AbstractFootMethod, ParameterBounds, project, update_feet
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._problem import Problem
from jaxfit._splines._pieces import Axis, Pieces


def measure_feet(
    method: AbstractFootMethod,
    problem: Problem,
    pieces: Pieces,
    before: FootPoints,
    foot_tolerance: Any,
) -> FootPoints:
    """Converged local feet, starting from the last ones, and the errors there."""
    idle, tolerance = ~jnp.asarray(problem.real), foot_tolerance * problem.diagonal
    feet, _ = update_feet(method, pieces, problem.target, before.u, before.v, tolerance, idle=idle)
    active = jnp.sum(problem.counted, dtype=jnp.int32)
    return FootPoints(
        *(feet.u, feet.v, feet.error, feet.evaluations, feet.converged, active, jnp.asarray(True)),
        before.summary,
    )


def measure_grid(
    method: AbstractFootMethod,
    problem: Problem,
    pieces: Pieces,
    before: FootPoints,
    foot_tolerance: Any,
    held: Bool[Any, " points"],
    within: ParameterBounds | None = None,
) -> FootPoints:
    """Feet of a grid's points, except those that are `held`.

    Feet that do not converge are searched on the borders. `within` are bounds for each foot.
    """
    feet = project(
        method,
        pieces,
        problem.target,
        before.u,
        before.v,
        foot_tolerance * problem.diagonal,
        jnp.asarray(FOOT_STEPS, jnp.int32),
        jnp.asarray(held),
        True,
        within,
    )
    error = jnp.where(held, 0.0, jnp.sqrt(jnp.where(held, 0.0, feet.squared_distance)))
    active = jnp.sum(problem.counted, dtype=jnp.int32)
    return FootPoints(
        *(feet.best_u, feet.best_v, error, feet.steps, feet.converged, active, jnp.asarray(True)),
        before.summary,
    )


def side_bounds(axes: tuple[Axis, Axis], nu: int, nv: int) -> ParameterBounds:
    """Bounds that keep the feet of a grid's border points on their border curves."""
    bounds = []
    for axis, number in zip(axes, (np.arange(nu)[:, None], np.arange(nv)[None, :]), strict=True):
        low, high = axis.breaks[0], axis.breaks[-1]
        last = number.size - 1
        bounds += [jnp.where(number == last, high, low), jnp.where(number == 0, low, high)]
    return tuple(jnp.broadcast_to(x, (nu, nv)).reshape(-1) for x in bounds)  # type: ignore[return-value]
