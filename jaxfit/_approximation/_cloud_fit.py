"""`fit_cloud`: one fit of a cloud, from checked arguments to its result."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxfit._approximation._beyond_border import points_beyond_border
from jaxfit._approximation._checked_arguments import checked_request
from jaxfit._approximation._errors import AbstractErrors, Feet, GlobalFeet
from jaxfit._approximation._fit_inputs import EndOfFit, FitInputs
from jaxfit._approximation._implicit_fit import (
    Fitted,
    derivative_ahead,
    polished_fitted,
    with_implicit_derivative,
)
from jaxfit._approximation._programs_ahead import programs_ahead
from jaxfit._approximation._room import Room, nearest_on, starts_on
from jaxfit._approximation._unrolled_fit import unrolled_fit
from jaxfit._checks import as_points, check_kind, is_concrete, without_derivatives
from jaxfit._closest import closest_point, neighbours_together
from jaxfit._fit._adjoints import ImplicitAdjoint, UnrolledAdjoint
from jaxfit._fit._history import public_history
from jaxfit._fit._loop import LoopState, begin, check_derivative, run
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._method_fields import dynamic_fields, static_fields
from jaxfit._fit._problem import Problem, Tolerances, make_problem
from jaxfit._fit._reasons import RESULTS, code_of, result_of
from jaxfit._fit._result import Fit, Name, converged_or_raise
from jaxfit._fit._scaling import Unit
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._precision import advise_x64, working_dtype
from jaxfit._progress_line import doing
from jaxfit._splines import BSplineSurface

LEAST_POINTS = 4


def fit_cloud(
    points: ArrayLike,
    base: BSplineSurface,
    method: AbstractIterativeMethod,
    request: dict[str, Any],
    room: Room | None = None,
) -> Fit:
    """`approximate`, its options in a dictionary.

    The fit runs on its arguments without their derivatives, which are concrete under `grad` alone. Without
    `room` it has no more than it needs.
    """
    check_kind("base", base, BSplineSurface, "base_surface(boundary)")
    cloud = as_points("points", points, base.dimension, least=LEAST_POINTS)
    dtype = working_dtype()
    given = (cloud if is_concrete(cloud) else cloud.astype(dtype), base, method, request)
    cloud, base, method, request = values = without_derivatives(given)
    unit, weight, feet = checked_request(cloud, base.domain, method=method, **request)
    goals, max_steps = (request["tol_average"], request["tol_maximum"]), request["max_steps"]
    _advise_precision(goals, base)
    concrete = is_concrete(cloud, base, weight, request["start"], goals, method)
    tolerances = tolerances_of(*goals, max_steps)
    problem = make_problem(cloud, weight, unit, tolerances, padded=concrete)
    begun = working_surface(base, unit, concrete)
    if room is not None:
        begun = begun.padded(room.net[0] - base.shape[0], room.net[1] - base.shape[1])
    unrolled = isinstance(request["adjoint"], UnrolledAdjoint)
    implicit = not unrolled and (request["adjoint"] is not None or not is_concrete(given))
    if concrete:
        programs_ahead(method, problem, begun, cloud.shape[0], request, room, implicit)
    u, v = (_padded(x, problem.weight.shape[0], dtype) for x in feet or _nearest(base, cloud, method, room))
    sorts = method.finds_feet or getattr(method, "loss", None) is not None  # whose scale looks at neighbours
    order = order_by_cell(begun, u, v, cloud.shape[0], sorts)
    if not is_concrete(order):
        u, v = jnp.asarray(u), jnp.asarray(v)
    together = problem.ordered(order)
    _announce(base.shape, cloud.shape[0], room)
    loop = begin(method, together, begun, u[order], v[order], max_steps if room is None else room.steps)
    first = _end(together, begun, loop, order, unit, begun)
    if implicit:
        _prepare_derivative(values, first, not is_concrete(given))
    if unrolled:
        loop, stats, unit = unrolled_fit(first, max_steps, *given)
        cloud, base, method, concrete = *given[:3], is_concrete(given)
    else:
        loop, stats = run(method, together, loop, request["progress"] if concrete else None)
    surface = fitted_surface(loop.current.surface, base, begun, unit)
    known = _in_given_order(loop, order, cloud.shape[0], unit, concrete)
    if implicit:
        end = _end(together, loop.current.surface, loop, order, unit, begun)
        surface, known, unit, share = _differentiable(given, end, surface, known)
        cloud, concrete = given[0], is_concrete(given)
        stats = stats | {"stationarity": share}
    parts = _at_feet(request["errors"], surface, cloud, known, method.finds_feet, concrete, room)
    stats = stats_of(method, tolerances, loop.current.step, unit, _sum(~parts[3])) | stats
    fit = _fit(loop, problem, cloud, parts, unit, surface, stats, getattr(method, "fairing", None), concrete)
    return converged_or_raise(fit) if request["throw"] else fit


def _advise_precision(goals: tuple[Any, Any], base: BSplineSurface) -> None:
    for tolerance in goals:
        if tolerance is not None and is_concrete(tolerance):
            advise_x64(float(np.asarray(tolerance)), np.dtype(base.control_points.dtype))


def _announce(net: tuple[int, int], count: int, room: Room | None) -> None:
    points = f"{count:,}" if room is None or room.points == count else f"{count:,} of {room.points:,}"
    doing(f"fitting {net[0]} x {net[1]} control points to {points} points")


def _nearest(
    base: BSplineSurface, cloud: Any, method: AbstractIterativeMethod, room: Room | None
) -> tuple[Any, Any]:
    """The parameters of the closest points; of nearly all, for methods that find feet themselves."""
    if is_concrete(base, cloud):
        if method.finds_feet:
            return starts_on(base, cloud, room)
        found = nearest_on(base, cloud, room=room)
        return found["u"], found["v"]
    nearest = closest_point(base, cloud)
    return nearest.u, nearest.v


def _prepare_derivative(values: Any, first: EndOfFit, differentiated: bool) -> None:
    """Have a method that has no implicit derivative say so before the fit, which may take long, and begin to
    compile what brings the fit to rest; `first` is where it begins.
    """
    _, _, method, request = values
    concrete = is_concrete(values, first)
    if concrete or request["adjoint"] is not None:
        check_derivative(method, first.problem, first)
    if concrete:
        adjoint = request["adjoint"] or ImplicitAdjoint()
        derivative_ahead(static_fields(method), adjoint, first, FitInputs.of(*values), differentiated)


def _end(
    problem: Problem, surface: WorkingSurface, loop: LoopState, order: Any, unit: Unit, begun: WorkingSurface
) -> EndOfFit:
    """The fit as it is now; `begun` is the base surface in the unit of the problem."""
    here, knots = loop.current, (begun.knots_u, begun.knots_v)
    return EndOfFit(problem, surface, here.state, here.projection, order, unit, knots)


def _differentiable(
    given: Any, end: EndOfFit, surface: BSplineSurface, known: Feet
) -> tuple[BSplineSurface, Feet, Unit, Any]:
    """The fit as a function of what is `given`: surface, feet, the unit with its diagonal, and how stationary
    it is: NaN where that is not known.
    """
    _, base, method, request = given
    dtype = end.problem.target.dtype
    inputs, (_, rest) = FitInputs.of(*given), dynamic_fields(method)
    adjoint = request["adjoint"]
    if adjoint is None:
        xp: Any = np if is_concrete(end, surface, known) else jnp  # NumPy compiles nothing
        net = xp.asarray(end.unit.outward(end.surface.control_points), dtype)
        same = xp.asarray(surface.control_points, dtype)  # to the last bit
        if same.shape != net.shape:
            room = [(0, a - b) for a, b in zip(net.shape, same.shape, strict=True)]
            same = xp.where(np.pad(np.ones(same.shape, bool), room), xp.pad(same, room), net)
        diagonal = xp.asarray(end.unit.diagonal, dtype)
        fitted = Fitted(same, *known[:3], diagonal, np.asarray(np.nan, dtype))
        fitted = with_implicit_derivative(rest, ImplicitAdjoint(), fitted, end, inputs)
    else:
        fitted = polished_fitted(rest, adjoint, end, inputs)
    nu, nv = surface.shape
    net = fitted.net[:nu, :nv].astype(base.control_points.dtype)
    surface = BSplineSurface(net, surface.knots_u, surface.knots_v)
    unit = dataclasses.replace(end.unit, diagonal=fitted.diagonal)
    return surface, (fitted.u, fitted.v, fitted.error, known[3]), unit, fitted.stationarity


def tolerances_of(tol_average: Any, tol_maximum: Any, max_steps: int) -> Tolerances:
    """The limits of a fit; None sets none."""
    dtype, parts = working_dtype(), []
    for x in (tol_average, tol_maximum):
        xp: Any = np if is_concrete(x) else jnp
        parts.append(xp.asarray(np.inf if x is None else x, dtype))
    return Tolerances(parts[0], parts[1], np.asarray(max_steps, np.int32))


def stats_of(
    method: AbstractIterativeMethod, tolerances: Tolerances, steps: Any, unit: Unit, unconverged_feet: Any
) -> dict[str, Any]:
    """What the `stats` of every fit of a cloud hold."""
    loss = getattr(method, "loss", None)
    return {
        "method": Name(type(method).__name__),
        **({} if loss is None else {"loss": Name(type(loss).__name__)}),
        "num_steps": steps,
        "tol_average": tolerances.average,
        "tol_maximum": tolerances.maximum,
        "diagonal": unit.diagonal,
        "unconverged_feet": unconverged_feet,
    }


def working_surface(base: BSplineSurface, unit: Unit, concrete: bool) -> WorkingSurface:
    """The base surface in the unit of the problem."""
    dtype = working_dtype()
    xp: Any = np if concrete else jnp
    net = xp.asarray(unit.inward(base.control_points), dtype)
    knots_u, knots_v = (
        np.asarray(x, dtype) if is_concrete(x) else x.astype(dtype) for x in (base.knots_u, base.knots_v)
    )
    return WorkingSurface.of(net, knots_u, knots_v)


def _padded(x: Any, size: int, dtype: Any) -> Any:
    """Starting parameters, repeated at the end up to the size of the problem."""
    xp: Any = np if is_concrete(x) else jnp
    x = xp.asarray(x, dtype)
    return xp.concatenate([x, xp.repeat(x[-1:], size - x.shape[0])]) if size > x.shape[0] else x


def order_by_cell(surface: WorkingSurface, u: Any, v: Any, count: int, sorts: bool = True) -> Any:
    """The points sorted by cell, on the host by rectangles of a uniform grid, the `count` true ones first.

    Neighbours in memory are then neighbours on the surface, and `_cells` lays them out faster. Where that is
    done but once it does not pay: unless it `sorts`, points on the host keep their order.
    """
    axis_u, axis_v = surface.axes
    if is_concrete(surface.axes, u, v):
        given = np.arange(u.shape[0])
        together = neighbours_together(surface.axes, u[:count], v[:count]) if sorts else given[:count]
        return np.append(together, given[count:])
    cells = axis_u.cells * axis_v.cells
    cell = axis_u.locate(u) * axis_v.cells + axis_v.locate(v)
    if u.shape[0] > count:
        cell = jnp.where(np.arange(u.shape[0]) >= count, cells, cell)
    return jnp.argsort(cell, stable=True)


def fitted_surface(
    end: WorkingSurface, base: BSplineSurface, begun: WorkingSurface, unit: Unit
) -> BSplineSurface:
    """The surface that a fit ended with, in the user's unit. Control points that did not move keep every bit.

    Inside transformations a net with room for knots keeps its surplus control points.
    """
    concrete = is_concrete(end, base)
    if concrete and end.control_points.shape != base.control_points.shape:
        end = end.trimmed()
    dtype = base.control_points.dtype
    xp: Any = np if concrete else jnp  # NumPy compiles nothing
    moved, given = xp.asarray(unit.outward(end.control_points), dtype), xp.asarray(base.control_points)
    if moved.shape == given.shape:
        nu, nv = base.shape
        still = xp.asarray(end.control_points) == xp.asarray(begun.control_points)[:nu, :nv]
        moved = xp.where(still, given, moved)
    elif not concrete:
        room = [(0, a - b) for a, b in zip(moved.shape, given.shape, strict=True)]
        given = jnp.pad(given, room, mode="edge")
    if not concrete:  # there points that are not finite are found out only here
        moved = jnp.where(jnp.all(jnp.isfinite(moved)), moved, given)
    parts = moved, xp.asarray(end.knots_u, dtype), xp.asarray(end.knots_v, dtype)
    return BSplineSurface(*(jax.device_put(parts) if concrete else parts))


def _in_given_order(loop: LoopState, order: Any, count: int, unit: Unit, concrete: bool) -> Feet:
    """The last feet, in the order of the points and in the user's unit."""
    here = loop.current.projection
    xp: Any = np if concrete else jnp
    if concrete:  # the inverse of a permutation needs no sort
        back = np.empty_like(order)
        back[order] = np.arange(order.size)
        back = back[:count]
    else:
        back = jnp.argsort(order)[:count]
    u, v, error, converged = (xp.asarray(x)[back] for x in (here.u, here.v, here.error, here.converged))
    return u, v, error * unit.scale, converged


def _at_feet(
    errors: AbstractErrors | None,
    surface: BSplineSurface,
    cloud: Any,
    known: Feet,
    at_feet: bool,
    concrete: bool,
    room: Room | None,
) -> Feet:
    """The feet at which the errors are measured."""
    if not concrete and at_feet:
        return known
    return (GlobalFeet() if errors is None else errors).feet(surface, cloud, known, at_feet, room)


def _fit(
    loop: LoopState,
    problem: Problem,
    cloud: Any,
    parts: Feet,
    unit: Unit,
    surface: BSplineSurface,
    stats: dict[str, Any],
    fairing: Any,
    concrete: bool,
) -> Fit:
    """The result. Averages and maxima are over the points of positive weight. Outside transformations errors
    include a bound on the rounding of the control points."""
    xp: Any = np if concrete else jnp
    u, v, distance = (xp.asarray(x) for x in parts[:3])
    loss = unit.loss(np.asarray(surface.control_points)) if concrete else None
    found = _relative if concrete else jax.jit(_relative)
    relative, average, maximum = found(distance, unit.diagonal, problem.weight, loss)
    arrays: Any = (u, v, relative, average, maximum)
    if concrete:
        counted = np.asarray(problem.weight)[: len(distance)] > 0
        stats = stats | _at_border(surface, cloud, (u, v), relative, counted)
        arrays = jax.device_put([np.asarray(x, problem.target.dtype) for x in arrays])
    return Fit(
        surface=surface,
        u=arrays[0],
        v=arrays[1],
        errors=arrays[2],
        average_error=arrays[3],
        maximum_error=arrays[4],
        history=public_history(loop.history, loop.current.step, fairing),
        result=result_of(
            final_code(loop.code, (average, maximum), loss, problem.tolerances) if concrete else loop.code
        ),
        stats=stats,
    )


def _relative(distance: Any, diagonal: Any, weight: Any, loss: Any) -> tuple[Any, Any, Any]:
    """The errors of all points, their average and their maximum, as fractions of the diagonal."""
    xp: Any = np if is_concrete(distance, diagonal, weight) else jnp  # NumPy compiles nothing for a new size
    relative = distance / diagonal if loss is None else distance / diagonal + loss
    counted = xp.asarray(weight)[: relative.shape[0]] > 0
    average = xp.sum(xp.where(counted, relative, 0.0)) / xp.sum(counted)
    maximum = xp.where(xp.isnan(average), average, xp.max(xp.where(counted, relative, 0.0)))
    return relative, average, maximum


def _at_border(surface: BSplineSurface, cloud: Any, feet: Any, errors: Any, counted: Any) -> dict[str, Any]:
    """How many points lie beyond the border, and their share of the sum of all errors."""
    errors, counted = np.asarray(errors), np.asarray(counted)
    beyond = points_beyond_border(surface, cloud, feet, errors, counted)
    share = errors[beyond].sum() / max(errors[counted].sum(), np.finfo(float).tiny)
    return {"points_beyond_border": beyond.sum(), "errors_beyond_border": share}


def final_code(code: Any, errors: tuple[Any, Any], loss: Any, goal: Tolerances) -> Any:
    """`code`, unless the final surface misses tolerances that were met in the loop: by no more than the
    `loss` to rounding, or because it has been polished; or unless the errors can't fall to a tolerance for
    this loss.
    """

    def met(slack: Any) -> bool:
        limits = goal.average, goal.maximum
        return all(float(error) - slack <= limit for error, limit in zip(errors, limits, strict=True))

    if int(code) == code_of(RESULTS.stalled) and any(
        0.0 < limit < float(loss) for limit in (goal.average, goal.maximum)
    ):
        return np.int32(code_of(RESULTS.rounded))
    if int(code) != code_of(RESULTS.converged) or met(0.0):
        return code
    return np.int32(code_of(RESULTS.rounded if met(float(loss)) else RESULTS.stalled))


def _sum(x: Any) -> Any:
    xp: Any = np if is_concrete(x) else jnp
    return xp.sum(xp.asarray(x))
