"""The contract of interpolation methods: a method returns a fit to a grid in the problem's unit."""

import dataclasses
from abc import abstractmethod
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._checks import is_concrete
from jaxfit._compile import compiled
from jaxfit._fit._history import (
    LEAST_ENTRIES,
    MOST_ENTRIES,
    ErrorHistory,
    History,
    public_history,
)
from jaxfit._fit._loop import Progress
from jaxfit._fit._reasons import RESULTS, code_of, result_of
from jaxfit._fit._result import Fit
from jaxfit._fit._scaling import Outward
from jaxfit._parameters import AbstractParametrisation, grid_parameters
from jaxfit._precision import bucket
from jaxfit._splines import BSplineSurface

Pair = tuple[Any, Any]

CORNERS = np.asarray([[0], [-1]]), np.asarray([[0, -1]])  # rows and columns


class Frame(eqx.Module):
    """Where the data lies, and how close the surface is to come. The diagonal is in the problem's unit.

    `goal` is the tolerance before the control points are rounded to the user's coordinates.
    """

    outward: Outward
    corners: Float[Any, "2 2 d"]  # of the grid, in the user's unit
    diagonal: Float[Any, ""]
    goal: Float[Any, ""]
    tolerance: Float[Any, ""]
    max_steps: Int[Any, ""]


class GridProblem(NamedTuple):
    """A grid to interpolate. Lengths are in the problem's unit, in which the diagonal is about 1."""

    data: Float[Any, "n m d"]
    normals: Float[Any, "n m d"] | None
    frame: Frame
    unit: Any  # `Unit`; None inside compiled code
    order: tuple[int, int]


class Solution(eqx.Module):
    """What a method finds. Lengths are in the problem's unit, errors are fractions of the diagonal."""

    net: Float[Any, "nu nv d"]
    knots: Pair
    u: Float[Any, "n m"]
    v: Float[Any, "n m"]
    errors: Float[Any, "n m"]
    history: History
    code: Int[Any, ""]  # of one of RESULTS, before the net is rounded
    steps: Int[Any, ""]
    unconverged_feet: Int[Any, ""]
    stats: dict[str, Any]


class AbstractInterpolation(eqx.Module):
    """A way to pass a surface through every point of a grid."""

    @staticmethod
    @abstractmethod
    def check_normals(normals: Any, grid: Any, order: tuple[int, int]) -> Any:
        """The normals that were given with `grid` (n, m, d), checked; raises where they cannot be met."""

    @abstractmethod
    def fit(self, problem: GridProblem, progress: Progress | None) -> Fit:
        """The whole fit."""


class AbstractDirectInterpolation(AbstractInterpolation):
    """A method that is computed in one go, compiled together with the fit that is made of it."""

    parametrisation: eqx.AbstractVar[AbstractParametrisation]

    @abstractmethod
    def solve(self, problem: GridProblem, history: ErrorHistory) -> Solution:
        """What `finish` makes a fit of; traced. `history` is empty, with room for all steps."""

    def fit(self, problem: GridProblem, progress: Progress | None) -> Fit:
        """Solve, and check what could not be checked before."""
        data, order, frame = problem.data, problem.order, problem.frame
        entries = min(bucket(int(frame.max_steps) + 1, LEAST_ENTRIES), MOST_ENTRIES)
        fit, extent = _compiled(self, entries, order, data, problem.normals, frame)
        fit.stats["diagonal"] = problem.unit.diagonal
        if is_concrete(fit.maximum_error):
            check_solved(self.parametrisation, order, data, extent, fit.maximum_error)
            if fit.history.average.shape[0] > 1:
                fit = dataclasses.replace(fit, history=_cut(fit.history, int(fit.stats["num_steps"]) + 1))
        return fit


@partial(compiled, kept=True, static_argnums=(0, 1, 2))
def _compiled(
    method: AbstractDirectInterpolation, entries: int, order: Pair, data: Any, normals: Any, frame: Frame
) -> tuple[Fit, Array]:
    """The fit, and the extent of the grid. To make the fit in here spares the host a good part of the time
    that a small one takes."""
    problem = GridProblem(data, normals, frame, None, order)
    empty = jax.tree.map(jnp.asarray, ErrorHistory.empty(entries - 1, data.dtype))
    solution = method.solve(problem, empty)
    return finish(solution, frame), extent_of(data)


def finish(solution: Solution, frame: Frame) -> Fit:
    """The fit in the user's unit, with the errors that rounding its control points may add."""
    xp: Any = np if is_concrete(solution, frame) else jnp
    points = frame.outward(xp.asarray(solution.net))
    # Corners are the data, to the last bit.
    if xp is np:
        points[CORNERS] = frame.corners
    else:
        points = points.at[CORNERS].set(frame.corners)
    errors = lax.stop_gradient(solution.errors + frame.outward.loss(points, frame.diagonal))
    average, maximum = xp.mean(errors), xp.max(errors)
    code = xp.asarray(solution.code, np.int32)
    rounded = (code == code_of(RESULTS.converged)) & (maximum > frame.tolerance)
    code = xp.where(rounded, np.int32(code_of(RESULTS.rounded)), code)
    code = xp.where(xp.isfinite(maximum), code, np.int32(code_of(RESULTS.diverged)))
    arrays = [points, *solution.knots, solution.u, solution.v, errors, average, maximum]
    if xp is np:
        arrays = jax.device_put([np.asarray(x, points.dtype) for x in arrays])
    net, knots_u, knots_v, u, v, errors, average, maximum = arrays
    return Fit(
        surface=BSplineSurface(net, knots_u, knots_v),
        u=u,
        v=v,
        errors=errors,
        average_error=average,
        maximum_error=maximum,
        history=solution.history,
        result=result_of(code),
        stats={
            "num_steps": solution.steps,
            "unconverged_feet": solution.unconverged_feet,
            "tolerance": frame.tolerance,
            **solution.stats,
        },
    )


def single_entry(errors: Float[Array, "n m"]) -> History:
    """The history of a method without iterations."""
    none = jnp.zeros(1, errors.dtype)
    return History(jnp.mean(errors)[None], jnp.max(errors)[None], none, none)


def _cut(history: History, made: int) -> History:
    """The last entries, oldest first, of so many that were made."""
    capacity = history.average.shape[0]
    kept = np.arange(max(made - capacity, 0), made) % capacity
    return jax.device_put(jax.tree.map(lambda x: np.asarray(x)[kept], history))


def errors_only(history: ErrorHistory, steps: Any) -> History:
    """The history as fits of grids report it."""
    whole = public_history(history, steps)
    return dataclasses.replace(whole, active=None, net=None, faired=None, refined=None)


def refuse_normals(method: str, normals: Any) -> None:
    """Raise where normals are given to a method that does not meet them."""
    if normals is not None:
        raise ValueError(f"normals cannot be met by {method}; pass method=NormalInterpolation().")


def extent_of(data: Float[Any, "n m d"]) -> Float[Array, "2"]:
    """How far a grid reaches along either index: if nowhere, its parameters are made up."""
    fixed = lax.stop_gradient(data)
    return jnp.stack(
        [jnp.max(jnp.abs(fixed[1:] - fixed[:-1])), jnp.max(jnp.abs(fixed[:, 1:] - fixed[:, :-1]))]
    )


def is_flat(extent: Any, inner: Any) -> bool:
    """Whether a concrete grid reaches nowhere along one index, but for rounding."""
    noise = 4 * float(np.finfo(inner.dtype).eps) * max(inner.shape)
    return bool((np.asarray(extent) <= noise).any())


def check_solved(
    parametrisation: AbstractParametrisation, order: tuple[int, int], inner: Any, extent: Any, result: Any
) -> None:
    """Raise where a concrete grid has no parameters, or its `result` is not finite."""
    if is_flat(extent, inner):
        # The exact test is the parametrisation's own; no row is shorter than its longest step.
        grid_parameters(inner, parametrisation)
    if not np.isfinite(np.asarray(result)).all():
        raise ValueError(
            f"grid is too unevenly spaced for order {tuple(order)} in {inner.dtype}, since its collocation "
            "matrix is singular to rounding; lower the order, or remove points that repeat."
        )
