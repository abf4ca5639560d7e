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
from jaxfit._fit._loop import Carry, Limits, begin, code_of, result_of, run
from jaxfit._fit._measure import border
from jaxfit._fit._problem import Problem, Unit, axes_of_averages, unit_of
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._result import Fit, history_of
from jaxfit._interpolation._geometric import GeometricInterpolation
from jaxfit._interpolation._foot_replay import FitInputs, Fitted, attach_derivative
from jaxfit._interpolation._outcome import extent_of, is_flat
from jaxfit._interpolation._repositioning import lowest_eigenvalue
from jaxfit._interpolation._adjoints import UnrolledAdjoint
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
    carry, problem = _iterated(method, order, fixed, max_steps, progress)
    if symmetry is not None:
        net = symmetry.symmetrise_points(carry.net)
        carry = eqx.tree_at(lambda c: c.net, carry, net if concrete else lax.stop_gradient(net))
    if concrete:
        return _fit(carry, problem, unit, grid, start.knots, tolerance)
    measured = carry.measured
    n, m, _ = grid.shape
    found = Fitted(carry.net, measured.u.reshape(n, m), measured.v.reshape(n, m))
    found = attach_derivative(dataclasses.replace(method, adjoint=adjoint), order, found, setting)
    carry = eqx.tree_at(lambda c: c.net, carry, found.net)
    feet = found.u.reshape(-1), found.v.reshape(-1)
    carry = eqx.tree_at(lambda c: (c.measured.u, c.measured.v), carry, feet)
    return _fit(carry, problem, unit, grid, start.knots, tolerance)


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


def _setting(
    method: GeometricInterpolation, inner: Any, start: Start, unit: Unit, tolerance: Any
) -> FitInputs:
    xp: Any = np if is_concrete(inner, tolerance) else jnp
    number = partial(xp.asarray, dtype=inner.dtype)
    diagonal = number(unit.diagonal / unit.scale)
    feet = number(method.foot_tolerance)
    return FitInputs(inner, start.knots, start.averaged, start.feet, diagonal, number(tolerance), feet)


def _iterated(
    method: GeometricInterpolation,
    order: tuple[int, int],
    setting: FitInputs,
    max_steps: int,
    progress: Any,
) -> tuple[Carry, Problem]:
    axes = axes_of_averages(setting.knots, order)
    xp: Any = np if is_concrete(setting) else jnp
    target = setting.data.reshape(-1, setting.data.shape[2]).T
    ones = np.ones(target.shape[1], target.dtype)  # the net fixes the size, so points are not padded
    lowest = lowest_eigenvalue(axes, setting.averaged) if method.needs_spectrum else None
    problem = Problem(target, ones, *axes, ones, setting.diagonal, setting.foot_tolerance, lowest)
    most = xp.asarray(max_steps, np.int32)
    limits = Limits(xp.full_like(setting.tolerance, np.inf), setting.tolerance, most)
    u, v = (x.reshape(-1) for x in setting.feet)
    carry = begin(method, setting.data, u, v, max_steps, problem)
    return run(method, problem, limits, carry, progress if is_concrete(setting) else None), problem


def _fit(carry: Carry, problem: Problem, unit: Unit, grid: Any, knots: Pair, tolerance: Any) -> Fit:
    n, m, _ = grid.shape
    concrete = is_concrete(carry, grid)
    xp: Any = np if concrete else jnp
    measured = jax.tree.map(np.asarray, carry.measured) if concrete else carry.measured
    # Corners are never moved: they are the data, to the last bit.
    corners = border(n, m, corners_only=True)[..., None]
    net = xp.asarray(carry.net)
    points = xp.where(corners, grid, unit.outward(net)).astype(net.dtype)
    errors = measured.error / problem.diagonal + lax.stop_gradient(unit.loss(points))
    missed = (carry.code == code_of(RESULTS.converged)) & (xp.max(errors) > tolerance)
    code = xp.where(missed, np.int32(code_of(RESULTS.rounded)), carry.code)
    lost = xp.sum(~measured.found)
    parts = [measured.u.reshape(n, m), measured.v.reshape(n, m), errors.reshape(n, m)]
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
        history=history_of(carry),
        result=result_of(code),
        stats={
            "num_steps": carry.step,
            "diagonal": unit.diagonal,
            "unconverged_feet": lost,
            "tolerance": tolerance,
        },
    )
