"""What the geometric methods share: feet brought up to date, and the border of a net."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxfit._closest import AbstractFootMethod, project
from jaxfit._fit._loop import Measured
from jaxfit._splines._pieces import Pieces

FOOT_STEPS = 40


def measure_feet(
    method: AbstractFootMethod,
    problem: Any,
    pieces: Pieces,
    measured: Measured,
    idle: Bool[Array, " points"],
    borders: bool,
) -> Measured:
    """Feet from the last ones, converged on the surface, and the errors there; `idle` points have none."""
    feet = project(
        method,
        pieces,
        problem.target,
        measured.u,
        measured.v,
        problem.foot_tolerance * problem.diagonal,
        jnp.asarray(FOOT_STEPS, jnp.int32),
        idle,
        borders,
    )
    error = jnp.where(idle, 0.0, jnp.sqrt(jnp.where(idle, 0.0, feet.best)))
    return Measured(feet.best_u, feet.best_v, error, feet.steps, feet.converged)


def border(nu: int, nv: int, corners_only: bool) -> Bool[Array, "nu nv"]:
    """Which control points lie on the border of the net, or only its corners."""
    end_u = jnp.zeros(nu, bool).at[jnp.asarray([0, nu - 1])].set(True)[:, None]
    end_v = jnp.zeros(nv, bool).at[jnp.asarray([0, nv - 1])].set(True)[None, :]
    return end_u & end_v if corners_only else end_u | end_v
