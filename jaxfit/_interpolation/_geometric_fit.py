"""From a grid to a Fit by geometric interpolation: units, symmetry, and the loop."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxfit._checks import is_concrete
from jaxfit._fit._border import corners
from jaxfit._fit._history import public_history, without_counts
from jaxfit._fit._loop import LoopState, begin, run
from jaxfit._fit._problem import Problem, Tolerances
from jaxfit._fit._reasons import RESULTS, code_of, result_of
from jaxfit._fit._result import Fit
from jaxfit._fit._scaling import Unit, unit_of
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._interpolation._geometric import GeometricInterpolation
from jaxfit._interpolation._geometric_derivative import Found, Setting, followed
from jaxfit._interpolation._outcome import extent_of, is_flat
from jaxfit._interpolation._repositioning import lowest_eigenvalue
from jaxfit._interpolation._transposed_solve import UnrolledAdjoint
from jaxfit._parameters import grid_parameters
from jaxfit._precision import interpolation_tolerance, working_dtype
from jaxfit._splines import BSplineSurface, Reflection, averaging_knots

Pair = tuple[Any, Any]


class Start(eqx.Module):
    """What the data gives before the first iteration."""

    feet: Pair  # (n, m) each
    averaged: Pair
    knots: Pair
    extent: Array


@partial(jax.jit, static_argnames=("method", "order", "axis"))
def started(method: GeometricInterpolation, order: tuple[int, int], axis: int | None, data: Array) -> Start:
    """Parameters and knots; symmetric along `axis` if that is given."""
    n, m, _ = data.shape
    parameters = grid_parameters(data, method.parametrisation)
    u, v = parameters.u, parameters.v
    rows = (parameters.rows_u, parameters.rows_v)
    if axis is not None:
        u, v = Reflection(axis).symmetrise_parameters(u, v)
        rows = Reflection(axis).symmetrise_parameters(*rows)
    knots = [averaging_knots(t, k) for t, k in zip((u, v), order, strict=True)]
    if axis is not None:
        knots[axis] = Reflection(axis).symmetrise_knots(knots[axis])
    if not method.per_point:
        rows = (jnp.broadcast_to(u[:, None], (n, m)), jnp.broadcast_to(v[None, :], (n, m)))
    return Start(rows, (u, v), (knots[0], knots[1]), extent_of(data))


def geometric_fit(
    method: GeometricInterpolation,
    grid: Any,
    order: tuple[int, int],
    tolerance: Any,
    max_steps: int,
    progress: Callable[[int, int, float, float], None] | None,
) -> Fit:
    """The whole fit of a checked grid.

    Raises ValueError where concrete data has no extent along one index, or no plane of symmetry.
    """
    unit = unit_of(grid.reshape(-1, grid.shape[2]), "points of grid")
    concrete = is_concrete(grid, tolerance)
    dtype = working_dtype()
    inner, symmetry = unit.inward(grid), method.symmetry
    if symmetry is not None:
        symmetry = symmetry.in_unit(unit.centre, unit.scale).located(inner)
        inner = symmetry.symmetrise_points(inner)
        grid = unit.outward(np.asarray(inner) if concrete else inner)
    # Of the method only what the loop needs, so that other choices compile nothing.
    adjoint, method = method.adjoint, dataclasses.replace(method, symmetry=None, adjoint=UnrolledAdjoint())
    inner = (np.asarray(inner) if concrete else inner).astype(dtype)
    order = (int(order[0]), int(order[1]))
    start = started(method, order, None if symmetry is None else symmetry.axis, inner)
    if concrete:
        start = jax.tree.map(np.asarray, start)
        _check(method, inner, start, symmetry)
    goal, tolerance = interpolation_tolerance(tolerance, dtype, unit.least_tolerance(dtype))
    setting = _setting(method, inner, start, unit, goal)
    fixed = lax.stop_gradient(setting) if not concrete else setting
    loop, problem = _iterated(method, order, fixed, max_steps, progress)
    end = loop.current
    net, here = end.surface.control_points, end.projection
    n, m, _ = grid.shape
    if symmetry is not None:
        net = symmetry.symmetrise_points(net)
        net = net if concrete else lax.stop_gradient(net)
    u, v = here.u, here.v
    if not concrete:
        found = Found(net, u.reshape(n, m), v.reshape(n, m))
        found = followed(dataclasses.replace(method, adjoint=adjoint), order, found, setting)
        net, u, v = found.net, found.u.reshape(-1), found.v.reshape(-1)
    end = eqx.tree_at(lambda x: (x.surface.control_points, x.projection.u, x.projection.v), end, (net, u, v))
    loop = eqx.tree_at(lambda x: x.current, loop, end)
    return _fit(loop, problem, unit, grid, start.knots, tolerance)


def _check(method: GeometricInterpolation, inner: Any, start: Start, symmetry: Reflection | None) -> None:
    """Raise where a grid has no parameters, so that the traced part made some up."""
    flat = is_flat(start.extent, inner)
    increasing = all((np.diff(x) > 0).all() for x in start.averaged)
    if symmetry is not None and flat:
        raise ValueError(
            f"symmetry leaves the grid no extent along one index, since it pairs points along axis="
            f"{symmetry.axis} that are no mirror images; pair the other index, or give the normal."
        )
    if not increasing or flat:
        grid_parameters(inner, method.parametrisation)


def _setting(method: GeometricInterpolation, inner: Any, start: Start, unit: Unit, tolerance: Any) -> Setting:
    xp: Any = np if is_concrete(inner, tolerance) else jnp
    number = partial(xp.asarray, dtype=inner.dtype)
    diagonal = number(unit.diagonal / unit.scale)
    feet = number(method.foot_tolerance)
    return Setting(inner, start.knots, start.averaged, start.feet, diagonal, number(tolerance), feet)


def _iterated(
    method: GeometricInterpolation,
    order: tuple[int, int],
    setting: Setting,
    max_steps: int,
    progress: Any,
) -> tuple[LoopState, Problem]:
    xp: Any = np if is_concrete(setting) else jnp
    target = setting.data.reshape(-1, setting.data.shape[2]).T
    # The net fixes the size, so points are not padded.
    ones, real = np.ones(target.shape[1], target.dtype), np.ones(target.shape[1], bool)
    far = xp.full_like(setting.tolerance, np.inf)
    limits = Tolerances(far, setting.tolerance, xp.asarray(max_steps, np.int32))
    problem = Problem(target, ones, real, setting.diagonal, xp.ones_like(far), limits)
    surface = WorkingSurface.of(setting.data, *setting.knots, simple=True)
    u, v = (x.reshape(-1) for x in setting.feet)
    loop = begin(method, problem, surface, u, v, max_steps)
    if method.needs_spectrum:
        lowest = lowest_eigenvalue(surface.axes, setting.averaged)
        loop = eqx.tree_at(lambda x: (x.current.state.lowest, x.next.state.lowest), loop, (lowest, lowest))
    loop, _ = run(method, problem, loop, progress if is_concrete(setting) else None)
    return loop, problem


def _fit(loop: LoopState, problem: Problem, unit: Unit, grid: Any, knots: Pair, tolerance: Any) -> Fit:
    n, m, _ = grid.shape
    concrete = is_concrete(loop, grid)
    xp: Any = np if concrete else jnp
    here, net = loop.current.projection, xp.asarray(loop.current.surface.control_points)
    here = jax.tree.map(np.asarray, here) if concrete else here
    # Corners are never moved: they are the data, to the last bit.
    points = xp.where(corners(n, m)[..., None], grid, unit.outward(net)).astype(net.dtype)
    errors = here.error / problem.diagonal + lax.stop_gradient(unit.loss(points))
    missed = (loop.code == code_of(RESULTS.converged)) & (xp.max(errors) > tolerance)
    code = xp.where(missed, np.int32(code_of(RESULTS.rounded)), loop.code)
    lost = xp.sum(~here.converged)
    parts = [here.u.reshape(n, m), here.v.reshape(n, m), errors.reshape(n, m)]
    parts = [*parts, xp.mean(errors), xp.max(errors)]
    if concrete:
        parts = jax.device_put([np.asarray(x, net.dtype) for x in parts])
    return Fit(
        surface=BSplineSurface(points, *knots),
        u=parts[0],
        v=parts[1],
        errors=parts[2],
        average_error=parts[3],
        maximum_error=parts[4],
        history=without_counts(public_history(loop.history, loop.current.step)),
        result=result_of(code),
        stats={
            "num_steps": loop.current.step,
            "diagonal": unit.diagonal,
            "unconverged_feet": lost,
            "tolerance": tolerance,
        },
    )
