"""From a grid to a Fit by standard interpolation: units, checks, and one dispatch."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._checks import is_concrete
from jaxfit._fit._loop import code_of
from jaxfit._fit._problem import Outward, unit_of
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._result import Fit, History
from jaxfit._interpolation._gmres import ErrorHistory, Limits
from jaxfit._interpolation._outcome import check_solved, ending
from jaxfit._interpolation._standard import StandardInterpolation, solved
from jaxfit._precision import bucket, interpolation_tolerance, working_dtype
from jaxfit._splines import BSplineSurface

# Rows and columns of the corners.
CORNERS = np.asarray([[0], [-1]]), np.asarray([[0, -1]])


class Place(eqx.Module):
    """Where the data lies, and what it is to be fitted to; the diagonal is in the problem's unit."""

    outward: Outward
    corners: Float[Any, "2 2 d"]
    diagonal: Float[Any, ""]
    goal: Float[Any, ""]
    tolerance: Float[Any, ""]
    most: Any


def standard_fit(
    method: StandardInterpolation,
    grid: Any,
    order: tuple[int, int],
    tolerance: Any,
    max_steps: int,
) -> Fit:
    """The whole fit of a checked grid.

    Raises ValueError where concrete data has no extent along one index, or is too uneven for the order.
    """
    unit = unit_of(grid.reshape(-1, grid.shape[2]), "points of grid")
    dtype = working_dtype()
    inner = unit.inward(grid).astype(dtype)
    goal, tolerance = interpolation_tolerance(tolerance, dtype, unit.least_tolerance(dtype))
    xp: Any = np if is_concrete(grid, tolerance) else jnp
    diagonal, goal, tolerance = (xp.asarray(x, dtype) for x in (unit.diagonal / unit.scale, goal, tolerance))
    corners = grid[CORNERS].astype(dtype)
    place = Place(unit.within(dtype), corners, diagonal, goal, tolerance, np.int32(max_steps))
    room = bucket(int(max_steps) + 1) if method.iterative else 1
    fit, extent = _fitted(method, (int(order[0]), int(order[1])), room, inner, place)
    fit.stats.update(diagonal=unit.diagonal, tolerance=place.tolerance)
    if is_concrete(fit):
        check_solved(method.parametrisation, order, inner, extent, fit.maximum_error)
        if method.iterative:
            fit = eqx.tree_at(lambda fit: fit.history, fit, _cut(fit.history, int(fit.stats["num_steps"])))
    return fit


@partial(jax.jit, static_argnames=("method", "order", "room"))
def _fitted(
    method: StandardInterpolation,
    order: tuple[int, int],
    room: int,
    data: Float[Array, "n m d"],
    place: Place,
) -> tuple[Fit, Array]:
    """The fit, of whose `stats` some come later, and the extent of the grid. To make the fit in here spares
    the host a good part of the time that a small one takes.
    """
    solution = solved(method, order, room, data, Limits(place.diagonal, place.goal, place.most))
    net = place.outward(solution.net).at[CORNERS].set(place.corners)  # the data, to the last bit
    loss = lax.stop_gradient(place.outward.loss(net, place.diagonal))
    history = solution.history
    average, maximum = (x + loss for x in history.last())
    spent = (history.step >= place.most) & method.iterative
    missed = jnp.where(spent, code_of(RESULTS.max_steps_reached), code_of(RESULTS.stalled))
    met = code_of(RESULTS.converged)
    stats = {
        "num_steps": history.step,
        "unconverged_feet": solution.lost,
        "corrections": solution.corrections,
        "parameter_change": solution.parameter_change,
    }
    fit = Fit(
        surface=BSplineSurface(net, *solution.knots),
        u=solution.u,
        v=solution.v,
        errors=solution.errors + loss,
        average_error=average,
        maximum_error=maximum,
        history=_history(history),
        result=ending(maximum, loss, place.tolerance, met, missed),
        stats=stats,
    )
    return fit, solution.extent


def _history(history: ErrorHistory) -> History:
    """The errors; solves evaluate nothing for a foot and move none, and corrections report in `stats`."""
    none = 0.0 * history.average
    return History(history.average, history.maximum, none, none)


def _cut(history: History, steps: int) -> History:
    """The history of a known number of steps. By JAX, every new length would be a new compilation."""
    return jax.device_put(jax.tree.map(lambda x: np.asarray(x)[: steps + 1], history))
