"""`approximate`: fits a base surface to scattered points."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxfit._approximation._checked_arguments import checked_request
from jaxfit._approximation._errors import AbstractErrors, Feet, GlobalFeet
from jaxfit._approximation._orthogonal import OrthogonalDistance
from jaxfit._checks import as_points, check_kind, eager_where_concrete, is_concrete
from jaxfit._closest import closest_point
from jaxfit._fit._history import public_history
from jaxfit._fit._loop import LoopState, Progress, begin, run
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._problem import Problem, Tolerances, make_problem
from jaxfit._fit._reasons import result_of
from jaxfit._fit._result import Fit, Name, converged_or_raise
from jaxfit._fit._scaling import Unit
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._precision import advise_x64, working_dtype
from jaxfit._splines import BSplineSurface

LEAST_POINTS = 4


@eager_where_concrete
def approximate(
    points: ArrayLike,
    base: BSplineSurface,
    method: AbstractIterativeMethod | None = None,
    tol_average: ArrayLike | None = 6e-4,
    tol_maximum: ArrayLike | None = None,
    max_steps: int = 200,
    weights: ArrayLike | None = None,
    start: Any = None,
    progress: Progress | None = None,
    throw: bool = False,
    errors: AbstractErrors | None = None,
) -> Fit:
    """Fit a surface with the net and the knots of `base` to a cloud of points.

    Parameters
    ----------
    points : array (points, d)
        In any order, any unit.
    base : BSplineSurface
        A first approximation, for instance from `base_surface`. Its knots are kept; new ones are inserted
        only where the method has an `insertion`.
    method : GeometricApproximation(), OrthogonalDistance(), StandardApproximation() or your own, optional
        Any `AbstractIterativeMethod`. Default OrthogonalDistance(), which comes closest in the fewest
        iterations and makes no new folds; one of GeometricApproximation(), the paper's, takes a fraction of
        its time. The fit's `stats["method"]` is the name.
    tol_average, tol_maximum : float or None
        The fit has converged when the average and the maximum error are at most these fractions of the
        diagonal of the data's bounding box. None sets no limit; with two Nones the base is returned. Default:
        6e-4 (the paper's 0.06 %) on average, no limit on the maximum.
    max_steps : int
        The largest number of iterations (default 200).
    weights : array (points,), optional
        The non-negative weight of each point (default 1). Errors are not weighted.
    start : pair of arrays (points,), optional
        Feet (u, v) on the base surface to start from; default the closest points, searched globally.
    progress : callable, optional
        Called as `progress(step, max_steps, average, maximum)` every now and then, outside transformations.
    throw : bool
        Raise a RuntimeError with the reason instead of returning a fit that has not converged.
    errors : GlobalFeet(), LocalFeet() or AtParameters(), optional
        Where the errors of the fit are measured (default GlobalFeet(), for every method): at true closest
        points, at local foot points, or at the parameters that the method ended with.

    Returns
    -------
    Fit
        Its errors are measured as `errors` says. The iteration itself and its history use local feet.

    Raises
    ------
    ValueError
        If points, weights or start have the wrong shape or are not finite, start lies outside the domain,
        there are fewer than four points, or all of them coincide.

    Notes
    -----
    Section 4 of Kineri, Wang, Lin and Maekawa (2012). Runs under `jit` and `vmap`; on a CPU a batch is fitted
    one after the other. Differentiating through a fit raises a TypeError. Outside transformations clouds are
    padded to one of four sizes per octave, so that a second cloud of similar size compiles nothing.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 10), np.linspace(0, 1, 6), indexing="ij")
    >>> grid = np.stack([x, y, x * y], axis=2)
    >>> base = jf.base_surface(jf.Boundary.from_grid(grid), net=(6, 5))
    >>> points = grid.reshape(-1, 3) + 0.2 * np.sin(3 * x * y).reshape(-1, 1)
    >>> fit = jf.approximate(points, base, max_steps=3)
    >>> fit.surface.shape, fit.errors.shape, bool(fit.history.average[-1] < fit.history.average[0])
    ((6, 5), (60,), True)
    >>> print(fit.message)
    the maximum number of iterations was reached before the tolerances were met; ...
    """
    request = {
        "tol_average": tol_average,
        "tol_maximum": tol_maximum,
        "max_steps": max_steps,
        "weights": weights,
        "start": start,
        "progress": progress,
        "throw": throw,
        "errors": errors,
    }
    return fit_cloud(points, base, default_method(method), request)


def default_method(method: AbstractIterativeMethod | None) -> AbstractIterativeMethod:
    """The method, or the default one for None."""
    return OrthogonalDistance() if method is None else method


def fit_cloud(
    points: ArrayLike, base: BSplineSurface, method: AbstractIterativeMethod, request: dict[str, Any]
) -> Fit:
    """`approximate`, its options in a dictionary."""
    check_kind("base", base, BSplineSurface, "base_surface(boundary)")
    cloud = as_points("points", points, base.dimension, least=LEAST_POINTS)
    dtype = working_dtype()
    cloud = cloud if is_concrete(cloud) else cloud.astype(dtype)
    unit, weight, feet = checked_request(cloud, base.domain, method=method, **request)
    goals, max_steps = (request["tol_average"], request["tol_maximum"]), request["max_steps"]
    for tolerance in goals:
        if tolerance is not None and is_concrete(tolerance):
            advise_x64(float(np.asarray(tolerance)), np.dtype(base.control_points.dtype))
    concrete = is_concrete(cloud, base, weight, request["start"], goals, method)
    tolerances = _tolerances(*goals, max_steps)
    problem = make_problem(cloud, weight, unit, tolerances, padded=concrete)
    begun = _working_surface(base, unit, concrete)
    if feet is None:
        nearest = closest_point(base, cloud)
        feet = nearest.u, nearest.v
    u, v = (_padded(x, problem.weight.shape[0], dtype) for x in feet)
    order = _order_by_cell(begun, u, v, cloud.shape[0])
    if not is_concrete(order):
        u, v = jnp.asarray(u), jnp.asarray(v)
    together = problem.ordered(order)
    loop = begin(method, together, begun, u[order], v[order], max_steps)
    loop, stats = run(method, together, loop, request["progress"] if concrete else None)
    surface = _fitted(loop, base, begun, unit)
    known = _in_given_order(loop, order, cloud.shape[0], unit, concrete)
    parts = _at_feet(request["errors"], surface, cloud, known, method.finds_feet, concrete)
    stats = {
        "method": Name(type(method).__name__),
        "num_steps": loop.current.step,
        "diagonal": unit.diagonal,
        "unconverged_feet": _sum(~parts[3]),
        **stats,
    }
    fit = _fit(loop, problem, parts, unit, surface, stats, getattr(method, "fairing", None))
    return converged_or_raise(fit) if request["throw"] else fit


def _tolerances(tol_average: Any, tol_maximum: Any, max_steps: int) -> Tolerances:
    dtype, parts = working_dtype(), []
    for x in (tol_average, tol_maximum):
        xp: Any = np if is_concrete(x) else jnp
        parts.append(xp.asarray(np.inf if x is None else x, dtype))
    return Tolerances(parts[0], parts[1], np.asarray(max_steps, np.int32))


def _working_surface(base: BSplineSurface, unit: Unit, concrete: bool) -> WorkingSurface:
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


def _order_by_cell(surface: WorkingSurface, u: Any, v: Any, count: int) -> Any:
    """The points sorted by cell, the `count` true ones first.

    Neighbours in memory are then neighbours on the surface, and `_cells` lays them out faster.
    """
    axis_u, axis_v = surface.axes
    xp: Any = np if is_concrete(surface.axes, u, v) else jnp
    cells = axis_u.cells * axis_v.cells
    cell = axis_u.locate(u) * axis_v.cells + axis_v.locate(v)
    if u.shape[0] > count:
        cell = xp.where(np.arange(u.shape[0]) >= count, cells, cell)
    # Numbers of 16 bits are what NumPy sorts in linear time.
    return xp.argsort(cell.astype(np.uint16) if cells < 1 << 16 else cell, stable=True)


def _fitted(loop: LoopState, base: BSplineSurface, begun: WorkingSurface, unit: Unit) -> BSplineSurface:
    """The fitted surface in the user's unit. Control points that have not moved keep every bit.

    Inside transformations a net with room for knots keeps its surplus control points.
    """
    end = loop.current.surface
    concrete = is_concrete(end, base)
    if concrete and end.control_points.shape != begun.control_points.shape:
        end = end.trimmed()
    dtype = base.control_points.dtype
    xp: Any = np if concrete else jnp  # NumPy compiles nothing
    moved = xp.asarray(unit.outward(end.control_points), dtype)
    if moved.shape == base.control_points.shape:
        still = xp.asarray(end.control_points) == xp.asarray(begun.control_points)
        moved = xp.where(still, xp.asarray(base.control_points), moved)
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
) -> Feet:
    """The feet at which the errors are measured."""
    if not concrete and at_feet:
        return known
    return (GlobalFeet() if errors is None else errors).feet(surface, cloud, known, at_feet)


def _fit(
    loop: LoopState,
    problem: Problem,
    parts: Feet,
    unit: Unit,
    surface: BSplineSurface,
    stats: dict[str, Any],
    fairing: Any,
) -> Fit:
    """The result. Averages and maxima are over the points of positive weight."""
    concrete = is_concrete(loop, parts, unit)
    xp: Any = np if concrete else jnp  # NumPy compiles nothing for a new size
    u, v, distance, _ = (xp.asarray(x) for x in parts)
    relative = distance / unit.diagonal
    counted = xp.asarray(problem.weight)[: relative.shape[0]] > 0
    average = xp.sum(xp.where(counted, relative, 0.0)) / xp.sum(counted)
    maximum = xp.max(xp.where(counted, relative, 0.0))
    arrays: Any = (u, v, relative, average, maximum)
    if concrete:
        arrays = jax.device_put([np.asarray(x, problem.target.dtype) for x in arrays])
    return Fit(
        surface=surface,
        u=arrays[0],
        v=arrays[1],
        errors=arrays[2],
        average_error=arrays[3],
        maximum_error=arrays[4],
        history=public_history(loop.history, loop.current.step, fairing),
        result=result_of(loop.code),
        stats=stats,
    )


def _sum(x: Any) -> Any:
    xp: Any = np if is_concrete(x) else jnp
    return xp.sum(xp.asarray(x))
