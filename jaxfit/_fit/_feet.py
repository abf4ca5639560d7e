"""Projects the points of a problem onto a surface: clouds with `update_feet`, grids with `project`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxfit._closest import (
    FOOT_STEPS,
    AbstractFootMethod,
    ParameterBounds,
    nearest_feet,
    project,
    update_feet,
)
from jaxfit._closest._chunks import CHUNK, chunk_size
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface
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


def measure_feet_on_host(
    method: AbstractFootMethod,
    problem: Problem,
    surface: WorkingSurface,
    before: FootPoints,
    foot_tolerance: float,
) -> FootPoints:
    """`measure_feet` where all is concrete, by the programs of `closest_point`."""
    count = int(np.sum(problem.real))  # the first ones
    points = np.asarray(problem.target)[:, :count].T
    start = np.asarray(before.u)[:count], np.asarray(before.v)[:count]
    net, axes = jax.tree.map(np.asarray, (surface.control_points, surface.axes))
    found = nearest_feet(
        *(method, net, *axes, points),
        start=start,
        borders=False,
        tolerance=foot_tolerance,
        max_steps=FOOT_STEPS,
        chunk=chunk_size(min(count, CHUNK)),
    )
    parts = [np.array(x) for x in (before.u, before.v, before.error, before.converged)]
    for part, name in zip(parts, ("u", "v", "distance", "converged"), strict=True):
        part[:count] = found[name]
    return eqx.tree_at(lambda p: (p.u, p.v, p.error, p.converged), before, tuple(parts))


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
