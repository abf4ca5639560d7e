"""From a grid with normals to a Fit: units, checks, and one dispatch."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfit._checks import as_floating, is_concrete
from jaxfit._fit._history import History
from jaxfit._fit._reasons import RESULTS, code_of
from jaxfit._fit._result import Fit
from jaxfit._fit._scaling import unit_of
from jaxfit._interpolation._hermite import NormalInterpolation, solved_with_normals
from jaxfit._interpolation._outcome import check_solved, ending
from jaxfit._precision import interpolation_tolerance, working_dtype
from jaxfit._splines import BSplineSurface

LEAST_ORDER = 3
UNIT_TO = 1e-3  # how far from 1 the length of a normal may be
DEFAULT_ANGLE = {"float64": 1e-9, "float32": 1e-3}


def normal_fit(
    method: NormalInterpolation,
    grid: Any,
    normals: Any,
    order: tuple[int, int],
    tolerance: Any,
) -> Fit:
    """The whole fit of a checked grid.

    Raises ValueError where normals do not belong to the grid or are no unit vectors, the order is below 3,
    the points are not in space, or concrete data has no extent along one index.
    """
    directions = _checked_normals(normals, grid, order)
    unit = unit_of(grid.reshape(-1, 3), "points of grid")
    concrete = is_concrete(grid, directions)
    dtype = working_dtype()
    xp: Any = np if concrete else jnp
    inner = unit.inward(grid).astype(dtype)
    directions = xp.asarray(directions, np.float64 if concrete else dtype)
    lengths = xp.linalg.norm(directions, axis=-1, keepdims=True)
    directions = (directions / xp.where(lengths > 0, lengths, 1.0)).astype(dtype)
    solution = solved_with_normals(method, (int(order[0]), int(order[1])), inner, directions)
    if concrete:
        solution = jax.tree.map(np.asarray, solution)
        check_solved(method.parametrisation, order, inner, solution.extent, solution.net)
    net = unit.outward(solution.net).astype(dtype)
    loss = lax.stop_gradient(unit.loss(net))
    errors = solution.residual / xp.asarray(unit.diagonal / unit.scale, dtype) + loss
    average, maximum, angle = xp.mean(errors), xp.max(errors), xp.max(solution.angles)
    u, v = solution.parameters
    shape = errors.shape
    _, allowed = interpolation_tolerance(tolerance, dtype, unit.least_tolerance(dtype))
    result = _ending(maximum, loss, angle, (allowed, method.normal_tolerance), dtype)
    once = xp.zeros(1, dtype)
    entries = [average[None] + once, maximum[None] + once, once, once]
    parts = [xp.broadcast_to(u[:, None], shape), xp.broadcast_to(v[None, :], shape), errors, average, maximum]
    if concrete:
        parts, entries = jax.device_put((parts, entries))
    stats = {
        "num_steps": np.int32(0),
        "diagonal": unit.diagonal,
        "unconverged_feet": np.int32(0),
        "tolerance": allowed,
        "normal_errors": solution.angles,
        "maximum_normal_error": angle,
    }
    return Fit(
        surface=BSplineSurface(net, *solution.knots),
        u=parts[0],
        v=parts[1],
        errors=parts[2],
        average_error=parts[3],
        maximum_error=parts[4],
        history=History(*entries),
        result=result,
        stats=stats,
    )


def _checked_normals(normals: Any, grid: Any, order: tuple[int, int]) -> Any:
    if normals is None:
        raise ValueError(
            "normals must be given for NormalInterpolation; pass unit vectors in the shape of the grid."
        )
    directions = as_floating("normals", normals, 3)
    if grid.shape[2] != 3 or directions.shape != grid.shape:
        raise ValueError(
            f"normals must hold one vector in space for each point of the grid, but their shapes are "
            f"{directions.shape} and {grid.shape}; give two arrays (n, m, 3)."
        )
    if min(order) < LEAST_ORDER:
        raise ValueError(
            f"order must be at least {LEAST_ORDER} in each direction to meet normals, but is {tuple(order)}; "
            "raise it."
        )
    if is_concrete(directions):
        lengths = np.linalg.norm(np.asarray(directions), axis=-1)
        worst = np.unravel_index(np.argmax(np.abs(lengths - 1)), lengths.shape)
        if abs(lengths[worst] - 1) > UNIT_TO:
            raise ValueError(
                f"normals must be unit vectors, but the one at {tuple(int(i) for i in worst)} has length "
                f"{lengths[worst]:.3g}; divide each by its length."
            )
    return directions


def _ending(maximum: Any, loss: Any, angle: Any, limits: tuple[Any, Any], dtype: Any) -> Any:
    """Why the fit ended."""
    tolerance, angle_limit = limits
    angle_limit = DEFAULT_ANGLE.get(np.dtype(dtype).name, 1e-3) if angle_limit is None else angle_limit
    xp: Any = np if is_concrete(angle) else jnp
    met = xp.where(angle > angle_limit, code_of(RESULTS.normals_missed), code_of(RESULTS.converged))
    return ending(maximum, loss, tolerance, met, code_of(RESULTS.stalled))
