"""Feet brought up to date on a surface that has moved."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxfit._closest import AbstractFootMethod, Border, project
from jaxfit._fit._problem import Problem
from jaxfit._fit._projection import Projection
from jaxfit._splines._pieces import Axis, Pieces

FOOT_STEPS = 40


def measure_feet(
    method: AbstractFootMethod,
    problem: Problem,
    pieces: Pieces,
    before: Projection,
    foot_tolerance: Any,
    idle: Bool[Any, " points"],
    borders: bool,
    within: Border | None = None,
) -> Projection:
    """Feet from the last ones, converged on the surface, and the errors there; `idle` points have none.

    `borders` and `within` are those of `project`.
    """
    feet = project(
        method,
        pieces,
        problem.target,
        before.u,
        before.v,
        foot_tolerance * problem.diagonal,
        jnp.asarray(FOOT_STEPS, jnp.int32),
        jnp.asarray(idle),
        borders,
        within,
    )
    error = jnp.where(idle, 0.0, jnp.sqrt(jnp.where(idle, 0.0, feet.best)))
    active = jnp.sum(problem.counted, dtype=jnp.int32)
    return Projection(feet.best_u, feet.best_v, error, feet.steps, feet.converged, active, jnp.asarray(True))


def side_bounds(axes: tuple[Axis, Axis], nu: int, nv: int) -> Border:
    """Bounds of the feet of a grid's points, such that those of border points stay on their border."""
    bounds = []
    for axis, number in zip(axes, (np.arange(nu)[:, None], np.arange(nv)[None, :]), strict=True):
        low, high = axis.breaks[0], axis.breaks[-1]
        last = number.size - 1
        bounds += [jnp.where(number == last, high, low), jnp.where(number == 0, low, high)]
    return tuple(jnp.broadcast_to(x, (nu, nv)).reshape(-1) for x in bounds)  # type: ignore[return-value]
