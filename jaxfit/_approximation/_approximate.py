"""The verb for scattered points: a surface near all of them, from a base surface."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxfit._approximation._checked_arguments import ApproximationMethod, checked_request
from jaxfit._approximation._geometric import GeometricApproximation
from jaxfit._approximation._global_feet import global_feet
from jaxfit._approximation._knot_insertion import cut, with_room
from jaxfit._approximation._standard import StandardApproximation, bending_energy, with_smoothing
from jaxfit._checks import (
    as_points,
    check_kind,
    eager_where_concrete,
    is_concrete,
)
from jaxfit._closest import closest_point
from jaxfit._fit._loop import Carry, Limits, begin, code_of, result_of, run
from jaxfit._fit._problem import Problem, Unit, axes_of, make_problem, order_by_cell, padded_start
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._result import Fit, Name, converged_or_raise, history_of
from jaxfit._precision import advise_x64, working_dtype
from jaxfit._splines import BSplineSurface

LEAST_POINTS = 4


@eager_where_concrete
def approximate(
    points: ArrayLike,
    base: BSplineSurface,
    method: ApproximationMethod | None = None,
    tol_average: ArrayLike | None = 6e-4,
    tol_maximum: ArrayLike | None = None,
    max_steps: int = 200,
    weights: ArrayLike | None = None,
    start: Any = None,
    progress: Callable[[int, int, float, float], None] | None = None,
    throw: bool = False,
) -> Fit:
    """A surface on the net and the knots of `base` that comes close to a cloud of points.

    Parameters
    ----------
    points : array (points, d)
        In any order, any unit.
    base : BSplineSurface
        A first approximation, for instance from `base_surface`. Its knots are kept, and others come between
        them only where the method has an `insertion`.
    method : GeometricApproximation(), OrthogonalDistance() or StandardApproximation(), optional
        Default: GeometricApproximation(), which asks for no smoothing. OrthogonalDistance comes closer in
        fewer iterations. The fit's `stats["method"]` says which it was.
    tol_average, tol_maximum : float or None
        The fit has converged when the average and the maximum error are at most these fractions of the
        diagonal of the data's bounding box; None asks for nothing (two Nones, and the base is
        returned). Default: 6e-4 (the paper's 0.06 %) on average.
    max_steps : int
        Most iterations.
    weights : array (points,), optional
        Non-negative; how much each point pulls. Errors are not weighted.
    start : pair of arrays (points,), optional
        Feet (u, v) on the base surface to start from; default the closest points, searched globally.
    progress : callable, optional
        Called as `progress(step, max_steps, average, maximum)` every now and then, outside transformations.
    throw : bool
        Raise a RuntimeError with the reason instead of returning a fit that has not converged.

    Returns
    -------
    Fit
        Errors are distances to true closest points: outside transformations the feet are looked for
        globally once more at the end. The iteration itself, and its history, follow local feet.

    Raises
    ------
    ValueError
        If points, weights or start have the wrong shape or are not finite, start lies outside the domain,
        there are fewer than four points, or all of them coincide.

    Notes
    -----
    Section 4 of Kineri, Wang, Lin and Maekawa (2012). Runs under `jit` and `vmap`; to
    differentiate through a fit raises a TypeError. Outside transformations clouds are padded to one of four
    sizes per octave, so that a second cloud of similar size compiles nothing.
    """
    method = GeometricApproximation() if method is None else method
    check_kind("base", base, BSplineSurface, "base_surface(boundary)")
    cloud = as_points("points", points, base.dimension, least=LEAST_POINTS)
    dtype = working_dtype()
    cloud = cloud if is_concrete(cloud) else cloud.astype(dtype)
    unit, pulls, feet = checked_request(
        cloud,
        base.domain,
        method=method,
        tol_average=tol_average,
        tol_maximum=tol_maximum,
        max_steps=max_steps,
        weights=weights,
        start=start,
        progress=progress,
        throw=throw,
    )
    for tolerance in (tol_average, tol_maximum):
        if tolerance is not None and is_concrete(tolerance):
            advise_x64(float(np.asarray(tolerance)), np.dtype(base.control_points.dtype))
    concrete = is_concrete(cloud, base, pulls, start, tol_average, tol_maximum, method)
    axes = axes_of(base, dtype)
    problem = make_problem(cloud, pulls, axes, unit, method.foot_tolerance)
    rule = method.smoothing if isinstance(method, StandardApproximation) else None
    if not isinstance(method, GeometricApproximation):
        method, problem = method.prepared(problem)
    size = problem.target.shape[1]
    begun = net = jnp.asarray(unit.inward(base.control_points), dtype)
    growth = None
    if method.insertion is not None:
        knots = base.knots_u.astype(dtype), base.knots_v.astype(dtype)
        net, growth = with_room(net, knots, axes, method.insertion.room(max_steps))
    if feet is not None:
        u, v = feet
    elif concrete:
        u, v, _, _ = global_feet(_projector(method), problem, net, growth, cloud.shape[0], max_steps)
    else:
        nearest = closest_point(base, cloud)
        u, v = nearest.u, nearest.v
    u, v = (padded_start(x, size, dtype) for x in (u, v))
    if isinstance(method, StandardApproximation):
        problem = with_smoothing(rule, method, problem, begun, u, v)
    limits, wrong = _limits(tol_average, tol_maximum, max_steps, problem)
    together = order_by_cell(axes, u, v, cloud.shape[0])
    carry = begin(method, net, u[together], v[together], max_steps, problem, growth)
    carry = run(method, problem.ordered(together), limits, carry, progress if concrete else None)
    if wrong is not None:
        code = jnp.where(wrong, np.int32(code_of(RESULTS.diverged)), carry.code)
        carry = eqx.tree_at(lambda c: c.code, carry, code)
    surface = _surface(carry, base, begun, unit)
    parts = _parts(carry, method, problem, together, cloud.shape[0], max_steps, concrete)
    if not concrete and _projector(method) is not method:  # feet that have never moved
        nearest = closest_point(surface, cloud)
        parts = (nearest.u, nearest.v, nearest.distance / unit.diagonal, nearest.converged)
    fit = _finished(carry, method, problem, parts, unit, surface, concrete)
    return converged_or_raise(fit) if throw else fit


def _limits(tol_average: Any, tol_maximum: Any, max_steps: int, problem: Problem) -> tuple[Limits, Any]:
    """When to stop: at once if a traced lambda is none. The second value says so: it counts as divergence."""
    dtype, smoothing = problem.target.dtype, problem.smoothing
    average, maximum = (jnp.asarray(jnp.inf if x is None else x, dtype) for x in (tol_average, tol_maximum))
    most = jnp.asarray(max_steps, jnp.int32)
    if smoothing is None or is_concrete(smoothing):
        return Limits(average, maximum, most), None
    wrong = ~(jnp.isfinite(smoothing) & (smoothing >= 0))
    return Limits(average, maximum, jnp.where(wrong, 0, most)), wrong


def _surface(carry: Carry, base: BSplineSurface, begun: Array, unit: Unit) -> BSplineSurface:
    """The fitted surface in the user's unit; control points that have not moved keep every bit.

    Inside transformations a net with room for more keeps its surplus control points.
    """
    parts: Any = (carry.net, base.knots_u, base.knots_v)
    if carry.growth is not None:
        growth, whole = carry.growth, not is_concrete(carry)
        parts = (carry.net, growth.knots_u, growth.knots_v) if whole else cut(carry.net, growth)
    net, *knots = parts
    dtype = base.control_points.dtype
    xp: Any = np if is_concrete(net, begun, base.control_points) else jnp  # NumPy compiles nothing
    moved = xp.asarray(unit.outward(net), dtype)
    if net.shape == begun.shape:
        still = xp.asarray(net) == xp.asarray(begun)
        moved = xp.where(still, xp.asarray(base.control_points), moved)
    return BSplineSurface(moved, *(jnp.asarray(x, dtype) for x in knots))


def _parts(
    carry: Carry,
    method: ApproximationMethod,
    problem: Problem,
    order: Any,
    count: int,
    max_steps: int,
    concrete: bool,
) -> Any:
    """Feet, errors and whether feet were found.

    Feet were followed locally; where another part of the surface has come nearer, that counts.
    """
    measured = carry.measured
    if concrete:
        measured = jax.tree.map(np.asarray, measured)
    parts = (measured.u, measured.v, measured.error / problem.diagonal, measured.found)
    if not concrete:
        back = jnp.argsort(order)
        return tuple(x[back] for x in parts)
    u, v, distances, found = (np.array(np.asarray(x)[:count]) for x in parts)
    projector = _projector(method)
    known = (u, v, distances * float(problem.diagonal), found) if projector is method else None
    # In the order of the loop, in which neighbours come together.
    together = problem.ordered(order)
    best = global_feet(projector, together, carry.net, carry.growth, count, max_steps, known)
    distance = best[2] / float(problem.diagonal)
    # A foot that has not converged is still on the surface: the distance is no less for that.
    nearer = best[3] & (distance <= distances * np.where(found, 1 - 1e-6, 1.0))
    for old, new in ((u, best[0]), (v, best[1]), (distances, distance), (found, best[3])):
        old[nearer] = new[nearer]
    place = np.argsort(order[:count])
    return tuple(x[place] for x in (u, v, distances, found))


def _projector(method: ApproximationMethod) -> ApproximationMethod:
    """A method whose loop finds feet: the method itself, so that nothing else is compiled, if it does."""
    if isinstance(method, StandardApproximation) and not method.parameter_correction:
        return GeometricApproximation(foot_method=method.foot_method, foot_tolerance=method.foot_tolerance)
    return method


def _finished(
    carry: Carry,
    method: ApproximationMethod,
    problem: Problem,
    parts: Any,
    unit: Unit,
    surface: BSplineSurface,
    concrete: bool,
) -> Fit:
    xp: Any = np if concrete else jnp  # NumPy compiles nothing for a new size
    u, v, errors = (jax.device_put(x) if concrete else x for x in parts[:3])
    return Fit(
        surface=surface,
        u=u,
        v=v,
        errors=errors,
        average_error=jnp.asarray(xp.mean(parts[2])),
        maximum_error=jnp.asarray(xp.max(parts[2])),
        history=history_of(carry, method),
        result=result_of(carry.code),
        stats={
            "method": Name(type(method).__name__),
            "num_steps": carry.step,
            "diagonal": unit.diagonal,
            "unconverged_feet": xp.sum(~parts[3]),
            **_smoothing_stats(carry, problem, unit),
        },
    )


def _smoothing_stats(carry: Carry, problem: Problem, unit: Unit) -> dict[str, Any]:
    """What methods with a thin plate add."""
    if problem.smoothing is None:
        return {}
    axes = (problem.axis_u, problem.axis_v) if carry.growth is None else carry.growth.axes
    energy = bending_energy(carry.net, *axes)
    stats = {"smoothing": problem.smoothing, "bending_energy": energy * unit.scale**2}
    trust = carry.next.trust
    if trust is None:
        return stats | {"shift": carry.next.shift}
    return stats | {"damping": trust.damping, "retreats": trust.retreats}
