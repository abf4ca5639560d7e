"""Geometric interpolation from a grid to a solution: symmetry, parameters, knots, the loop, derivatives."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxfit._checks import is_concrete
from jaxfit._compile import compiled
from jaxfit._compile_ahead import is_first
from jaxfit._fit._adjoints import ImplicitAdjoint
from jaxfit._fit._loop import LoopState, begin, compile_ahead, run
from jaxfit._fit._method_fields import static_fields
from jaxfit._fit._problem import Problem, Tolerances
from jaxfit._fit._working_surface import WorkingSurface, plane
from jaxfit._interpolation._foot_replay import FitInputs, Fitted, attach_derivative
from jaxfit._interpolation._linear_finish import finished_at_grid, with_larger_stall_gain
from jaxfit._interpolation._method import (
    CORNERS,
    Frame,
    GridProblem,
    Pair,
    Progress,
    Solution,
    errors_only,
    extent_of,
    is_flat,
)
from jaxfit._interpolation._step_weights import lowest_eigenvalue
from jaxfit._parameters import AbstractParametrisation, grid_parameters
from jaxfit._splines import Reflection, averaging_knots


class Start(eqx.Module):
    """What the data gives before the first iteration."""

    feet: Pair  # (n, m) each
    averaged: Pair
    knots: Pair
    extent: Array


@partial(compiled, kept=True, static_argnums=(0, 1, 2, 3))
def make_start(
    parametrisation: AbstractParametrisation,
    per_point: bool,
    order: tuple[int, int],
    axis: int | None,
    data: Array,
) -> Start:
    """Parameters and knots; symmetric along `axis` if that is given."""
    n, m, _ = data.shape
    parameters = grid_parameters(data, parametrisation)
    u, v = parameters.u, parameters.v
    rows = (parameters.rows_u, parameters.rows_v)
    if axis is not None:
        u, v = Reflection(axis).symmetrise_parameters(u, v)
        rows = Reflection(axis).symmetrise_parameters(*rows)
    knots = [averaging_knots(t, k) for t, k in zip((u, v), order, strict=True)]
    if axis is not None:
        knots[axis] = Reflection(axis).symmetrise_knots(knots[axis])
    if not per_point:
        rows = (jnp.broadcast_to(u[:, None], (n, m)), jnp.broadcast_to(v[None, :], (n, m)))
    return Start(rows, (u, v), (knots[0], knots[1]), extent_of(data))


def geometric_fit(method: Any, problem: GridProblem, progress: Progress | None) -> tuple[Solution, Frame]:
    """The solution, and the frame with the corners of what has been fitted.

    Raises ValueError where concrete data has no extent along one index, or no plane of symmetry.
    """
    data, frame, symmetry, stats = problem.data, problem.frame, method.symmetry, {}
    concrete = is_concrete(data, frame)
    if symmetry is not None:
        symmetry = symmetry.in_unit(problem.unit.centre, problem.unit.scale).located(data)
        stats["asymmetry"] = lax.stop_gradient(symmetry.asymmetry(data)) / frame.diagonal
        data = symmetry.symmetrise_points(data)
        data = np.asarray(data) if concrete else data
        frame = dataclasses.replace(frame, corners=frame.outward(data[CORNERS]))
    axis = None if symmetry is None else symmetry.axis
    how = with_larger_stall_gain(method) if concrete and method.solve_stalled else method
    # Without a derivative no feet need to be remembered.
    how = dataclasses.replace(how, adjoint=ImplicitAdjoint()) if concrete else how
    if concrete:
        _compile_ahead(how, problem.order, data, frame)
    start = make_start(method.parametrisation, method.per_point, problem.order, axis, data)
    if concrete:
        start = jax.tree.map(np.asarray, start)
        _check(method, data, start, symmetry)
    xp: Any = np if concrete else jnp
    foot_tolerance = xp.asarray(method.foot_tolerance, data.dtype)
    inputs = FitInputs(
        data, start.knots, start.averaged, start.feet, frame.diagonal, frame.goal, foot_tolerance
    )
    loop = _iterated(how, inputs if concrete else lax.stop_gradient(inputs), frame.max_steps, progress)
    end, shape = loop.current, data.shape[:2]
    net, here = end.surface.control_points, end.projection
    if symmetry is not None:
        net = symmetry.symmetrise_points(net)
        net = net if concrete else lax.stop_gradient(net)
    u, v = here.u.reshape(shape), here.v.reshape(shape)
    if not concrete:
        # Of the method only what plays a part, so that other choices compile nothing.
        how = dataclasses.replace(method, symmetry=None, solve_stalled=False)
        fitted = attach_derivative(how, problem.order, Fitted(net, u, v), end.state.path, inputs)
        net, u, v = fitted.net, fitted.u, fitted.v
    error, lost = (
        here.error,
        jnp.sum(~here.converged) if not concrete else np.sum(~np.asarray(here.converged)),
    )
    solution = Solution(
        net=np.asarray(net) if concrete else net,
        knots=start.knots,
        u=u,
        v=v,
        errors=(np.asarray(error) if concrete else error).reshape(shape) / frame.diagonal,
        history=errors_only(loop.history, end.step),
        code=loop.code,
        steps=end.step,
        unconverged_feet=lost,
        stats={"diagonal": problem.unit.diagonal, "solved": np.bool_(False), **stats},
    )
    if concrete and method.solve_stalled:
        found = solution
        solution = finished_at_grid(problem.order, data, start.averaged, symmetry, frame, loop, found)
        if progress is not None and solution is not found:
            errors = float(solution.errors.mean()), float(solution.errors.max())
            progress(int(solution.steps), int(frame.max_steps), *errors)
    return solution, frame


def _check(method: Any, inner: Any, start: Start, symmetry: Reflection | None) -> None:
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


def _compile_ahead(method: Any, order: tuple[int, int], data: Any, frame: Frame) -> None:
    """Begin to compile the iteration on a concrete grid, whatever its parameters will be."""
    dtype, max_steps = np.dtype(data.dtype), int(frame.max_steps)
    method = dataclasses.replace(method, symmetry=None, solve_stalled=False)
    extent = [np.abs(np.diff(data, axis=k)).max() for k in (0, 1)]
    if is_flat(extent, data) or not is_first(static_fields(method), order, data.shape, dtype, max_steps):
        return
    at_u, at_v = (np.linspace(0, 1, n, dtype=dtype) for n in data.shape[:2])
    feet = np.broadcast_to(at_u[:, None], data.shape[:2]), np.broadcast_to(at_v, data.shape[:2])
    flat = plane(data.shape, order, dtype)
    knots, tolerance = (flat.knots_u, flat.knots_v), np.asarray(method.foot_tolerance, dtype)
    inputs = FitInputs(data, knots, (at_u, at_v), feet, frame.diagonal, frame.goal, tolerance)
    compile_ahead(method, *_begun(inputs, frame.max_steps), max_steps)


def _begun(inputs: FitInputs, max_steps: Any) -> tuple[Problem, WorkingSurface]:
    """What is iterated, and the surface that this begins with: the data are its control points."""
    xp: Any = np if is_concrete(inputs) else jnp
    target = inputs.data.reshape(-1, inputs.data.shape[2]).T
    # The net fixes the size, so points are not padded.
    ones, real = np.ones(target.shape[1], target.dtype), np.ones(target.shape[1], bool)
    far = xp.full_like(inputs.tolerance, np.inf)
    limits = Tolerances(far, inputs.tolerance, max_steps)
    problem = Problem(target, ones, real, inputs.diagonal, xp.ones_like(far), limits)
    return problem, WorkingSurface.of(inputs.data, *inputs.knots, simple=True)


def _iterated(method: Any, inputs: FitInputs, max_steps: Any, progress: Progress | None) -> LoopState:
    # Under `grad` outside `jit` they are: `stop_gradient` leaves values. So this says nothing of derivatives.
    concrete = is_concrete(inputs)
    method = dataclasses.replace(method, symmetry=None, solve_stalled=False)
    problem, surface = _begun(inputs, max_steps)
    u, v = (x.reshape(-1) for x in inputs.feet)
    loop = begin(method, problem, surface, u, v, int(max_steps))
    if method.needs_spectrum:
        lowest = lowest_eigenvalue(surface.axes, inputs.averaged)
        loop = eqx.tree_at(lambda x: (x.current.state.lowest, x.next.state.lowest), loop, (lowest, lowest))
    return run(method, problem, loop, progress if concrete else None)[0]
