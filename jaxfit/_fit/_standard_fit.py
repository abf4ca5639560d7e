"""From a grid to a Fit by standard interpolation: units, checks, and one dispatch."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfit._checks import is_concrete
from jaxfit._fit._fit_result import Fit, History
from jaxfit._fit._grid_outcome import check_solved, ending
from jaxfit._fit._grid_systems import Account
from jaxfit._fit._loop import code_of
from jaxfit._fit._problem import Unit, unit_of
from jaxfit._fit._results import RESULTS
from jaxfit._fit._standard_interpolation import Solution, StandardInterpolation, solved
from jaxfit._precision import bucket, interpolation_tolerance, working_dtype
from jaxfit._splines import BSplineSurface


def standard_fit(
    method: StandardInterpolation,
    grid: Any,
    order: tuple[int, int],
    tolerance: Any,
    max_steps: int,
    throw: bool,
) -> Fit:
    """The whole fit of a checked grid.

    Raises ValueError where concrete data has no extent along one index, or is too uneven for the order.
    """
    unit = unit_of(grid.reshape(-1, grid.shape[2]))
    concrete = is_concrete(grid)
    dtype = working_dtype() if concrete else jnp.result_type(grid, float)
    inner = unit.inward(grid).astype(dtype)
    goal, tolerance = interpolation_tolerance(tolerance, np.dtype(dtype), unit.least_tolerance(dtype))
    xp: Any = np if is_concrete(grid, tolerance, max_steps) else jnp
    limits = (
        xp.asarray(unit.diagonal / unit.scale, dtype),
        xp.asarray(goal, dtype),
        xp.asarray(max_steps, np.int32),
    )
    room = bucket(int(max_steps) + 1) if method.iterative else 1
    solution = solved(method, (int(order[0]), int(order[1])), room, inner, limits)
    if is_concrete(solution):
        check_solved(method.parametrisation, order, inner, solution.extent, solution.maximum)
    return _fit(solution, unit, grid, (xp.asarray(tolerance, dtype), limits[2]), throw)


def _fit(solution: Solution, unit: Unit, grid: Any, limits: tuple[Any, Any], throw: bool) -> Fit:
    concrete = is_concrete(solution)
    account = solution.account
    net = unit.outward(np.asarray(solution.net) if concrete else solution.net)
    ends = np.asarray([0, -1])
    corner = ends[:, None], ends[None, :]
    # Corners are the data, to the last bit.
    if concrete:
        net[corner] = np.asarray(grid)[corner]
        net = jnp.asarray(net, solution.net.dtype)
    else:
        net = net.at[corner].set(grid[corner].astype(net.dtype))
    stats = {
        "num_steps": account.step,
        "diagonal": unit.diagonal,
        "unconverged_feet": solution.lost,
        "tolerance": limits[0],
        "corrections": solution.corrections,
        "parameter_change": solution.parameter_change,
    }
    surface = BSplineSurface(net, *solution.knots)
    loss = unit.loss(np.asarray(net)) if concrete else lax.stop_gradient(unit.loss(net))
    fields = (solution.errors, solution.average, solution.maximum)
    errors = [(np.asarray(x) if concrete else x) + loss for x in fields]
    result = _ending(errors[2], loss, account.step, limits, net, throw)
    parts: Any = jax.device_put(errors) if concrete else errors
    feet = solution.u, solution.v
    return Fit(surface, *feet, parts[0], parts[1], parts[2], _history(account), result, stats)


def _history(account: Account) -> History:
    """The errors; solves evaluate nothing for a foot and move none, and corrections report in `stats`."""
    average, maximum = account.average, account.maximum
    if not is_concrete(account):
        none = 0.0 * average
        return History(average, maximum, none, none)
    end = int(account.step) + 1
    if average.shape != (end,):
        average, maximum = (jnp.asarray(np.asarray(x)[:end]) for x in (average, maximum))
    none = jnp.asarray(np.zeros(end, average.dtype))
    return History(average, maximum, none, none)


def _ending(maximum: Any, loss: Any, step: Any, limits: tuple[Any, Any], net: Any, throw: bool) -> Any:
    """Why the fit stopped; raises the sentence if `throw` and it has not converged."""
    tolerance, most = limits
    xp: Any = np if is_concrete(step, most) else jnp
    spent = (step >= most) & (step > 0)
    missed = xp.where(spent, code_of(RESULTS.max_steps_reached), code_of(RESULTS.stalled))
    return ending(maximum, loss, tolerance, code_of(RESULTS.converged), missed, net, throw)
