"""What the geometric methods share: feet brought up to date, and the border of a net."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool

from jaxfit._closest import AbstractFootMethod, Border, project
from jaxfit._fit._loop import Measured
from jaxfit._splines._pieces import Axis, Pieces

FOOT_STEPS = 40


def measure_feet(
    method: AbstractFootMethod,
    problem: Any,
    pieces: Pieces,
    measured: Measured,
    idle: Bool[Any, " points"],
    borders: bool,
    within: Border | None = None,
) -> Measured:
    """Feet from the last ones, converged on the surface, and the errors there; `idle` points have none.

    `borders` and `within` are those of `project`.
    """
    feet = project(
        method,
        pieces,
        problem.target,
        measured.u,
        measured.v,
        problem.foot_tolerance * problem.diagonal,
        jnp.asarray(FOOT_STEPS, jnp.int32),
        jnp.asarray(idle),
        borders,
        within,
    )
    error = jnp.where(idle, 0.0, jnp.sqrt(jnp.where(idle, 0.0, feet.best)))
    return Measured(feet.best_u, feet.best_v, error, feet.steps, feet.converged)


def border(nu: int, nv: int, corners_only: bool) -> Bool[np.ndarray, "nu nv"]:
    """Which control points lie on the border of the net, or only its corners."""
    return _border(np.arange(nu), np.arange(nv), nu, nv, corners_only)


def border_on(axes: tuple[Axis, Axis], shape: tuple[int, ...], corners_only: bool) -> Bool[Array, "nu nv"]:
    """The same of a net with room for more; the surplus counts as border."""
    number_u, number_v = jnp.arange(shape[0]), jnp.arange(shape[1])
    held = _border(number_u, number_v, axes[0].used, axes[1].used, corners_only)
    return held | (number_u >= axes[0].used)[:, None] | (number_v >= axes[1].used)[None, :]


def _border(number_u: Any, number_v: Any, nu: Any, nv: Any, corners_only: bool) -> Any:
    end_u = ((number_u == 0) | (number_u == nu - 1))[:, None]
    end_v = ((number_v == 0) | (number_v == nv - 1))[None, :]
    return end_u & end_v if corners_only else end_u | end_v


def side_bounds(axes: tuple[Axis, Axis], nu: int, nv: int) -> Border:
    """Bounds of the feet of a grid's points, such that those of border points stay on their border."""
    bounds = []
    for axis, number in zip(axes, (np.arange(nu)[:, None], np.arange(nv)[None, :]), strict=True):
        low, high = axis.breaks[0], axis.breaks[-1]
        last = number.size - 1
        bounds += [jnp.where(number == last, high, low), jnp.where(number == 0, low, high)]
    return tuple(jnp.broadcast_to(x, (nu, nv)).reshape(-1) for x in bounds)  # type: ignore[return-value]
