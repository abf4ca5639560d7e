"""The verb for grids: a surface through all of them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxfit._checks import as_floating, check_kind, check_number, check_order, is_concrete
from jaxfit._fit._fit_result import Fit, history_of, outcome
from jaxfit._fit._geometric_interpolation import GeometricInterpolation
from jaxfit._fit._loop import Limits, begin, run
from jaxfit._fit._measure import border
from jaxfit._fit._problem import make_problem, unit_of
from jaxfit._fit._repositioning import lowest_eigenvalue
from jaxfit._fit._standard_fit import standard_fit
from jaxfit._fit._standard_interpolation import StandardInterpolation
from jaxfit._parameters import grid_parameters
from jaxfit._precision import interpolation_tolerance
from jaxfit._splines import BSplineSurface, averaging_knots


def interpolate(
    grid: ArrayLike,
    method: GeometricInterpolation | StandardInterpolation | None = None,
    order: tuple[int, int] = (4, 4),
    tolerance: float | None = None,
    max_steps: int = 1000,
    progress: Callable[[int, int, float, float], None] | None = None,
    throw: bool = False,
) -> Fit:
    """A B-spline surface with one control point per grid point, through every grid point.

    Parameters
    ----------
    grid : array (n, m, d)
        Any unit; at least `order` points in each direction.
    method : GeometricInterpolation or StandardInterpolation, optional
    order : (K, L)
        Degree + 1 along the first and the second index, each 2 to 8.
    tolerance : float, optional
        The largest error allowed, as a fraction of the diagonal of the data's bounding box. Default
        1e-12 in float64, 2e-6 in float32.
    max_steps : int
        Most iterations (of `StandardInterpolation`, cycles of GMRES).
    progress : callable, optional
        Called as `progress(step, max_steps, average, maximum)` every now and then, outside transformations;
        not by `StandardInterpolation`, which is done in one go.
    throw : bool
        Raise a RuntimeError with the reason instead of returning a fit that has not converged.

    Returns
    -------
    Fit
        `u`, `v` and `errors` have the shape (n, m) of the grid.

    Raises
    ------
    ValueError
        If the grid has the wrong shape, too few points, entries that are not finite, or no extent.

    Notes
    -----
    Sections 2.2 and 3 of Kineri, Wang, Lin and Maekawa (2012). Runs under `jit` and `vmap`; standard fits
    are differentiable too, while to differentiate through a geometric one raises a TypeError. On a closed
    grid (first row equal to the last) the feet stay on their side of the seam.
    """
    check_order(order)
    check_number("max_steps", max_steps, 0, whole=True)
    if tolerance is not None:
        check_number("tolerance", tolerance, 0.0)
    data = _checked_grid(grid, order)
    method = GeometricInterpolation() if method is None else method
    if isinstance(method, StandardInterpolation):
        return standard_fit(method, data, order, tolerance, max_steps, throw)
    check_kind("method", method, GeometricInterpolation, "GeometricInterpolation()")
    n, m, d = data.shape
    unit = unit_of(data.reshape(-1, d))
    inner = unit.inward(data)
    symmetry = method.symmetry
    if symmetry is not None:
        symmetry = symmetry.in_unit(unit.centre, unit.scale).located(inner)
        inner = symmetry.symmetrise_points(inner)
        data = unit.outward(np.asarray(inner) if is_concrete(inner) else inner)
        method = dataclasses.replace(method, symmetry=None)
    parameters = grid_parameters(inner, method.parametrisation)
    starts = parameters[:2] if symmetry is None else symmetry.symmetrise_parameters(*parameters[:2])
    knots = [averaging_knots(t, k) for t, k in zip(starts, order, strict=True)]
    if symmetry is not None:
        knots[symmetry.axis] = symmetry.symmetrise_knots(knots[symmetry.axis])
    net = jnp.asarray(inner)
    surface = BSplineSurface(net, *knots)
    tolerance = interpolation_tolerance(tolerance, np.dtype(surface.control_points.dtype))
    # The net fixes the size of the problem, so its points are not padded.
    cloud = data.reshape(-1, d)
    problem = make_problem(cloud, None, surface, unit, method.foot_tolerance, padded=False)
    dtype = problem.target.dtype
    if method.needs_spectrum:
        averaged = tuple(x.astype(dtype) for x in starts)
        lowest = lowest_eigenvalue((problem.axis_u, problem.axis_v), averaged)
        problem = eqx.tree_at(lambda p: p.lowest, problem, lowest, is_leaf=lambda x: x is None)
    u, v = jnp.repeat(starts[0].astype(dtype), m), jnp.tile(starts[1].astype(dtype), n)
    limits = Limits(
        jnp.asarray(jnp.inf, dtype),
        jnp.asarray(tolerance, dtype),
        jnp.asarray(max_steps, jnp.int32),
    )
    carry = begin(surface.control_points.astype(dtype), u, v, max_steps)
    carry = run(method, problem, limits, carry, progress if is_concrete(data) else None)
    if symmetry is not None:
        carry = eqx.tree_at(lambda c: c.net, carry, symmetry.symmetrise_points(carry.net))
    return _finished(carry, problem, unit, data, surface, throw)


def _finished(carry: Any, problem: Any, unit: Any, grid: Any, surface: BSplineSurface, throw: bool) -> Fit:
    n, m, _ = grid.shape
    measured = carry.measured
    # Corners are never moved: they are the data, to the last bit.
    points = unit.outward(np.asarray(carry.net) if is_concrete(carry) else carry.net)
    points = jnp.asarray(points)
    corners = border(points.shape[0], points.shape[1], corners_only=True)[..., None]
    points = jnp.where(corners, jnp.asarray(grid, points.dtype), points)
    average, maximum, _, _ = problem.summarise(measured, measured)
    return Fit(
        surface=BSplineSurface(points, surface.knots_u, surface.knots_v),
        u=measured.u.reshape(n, m),
        v=measured.v.reshape(n, m),
        errors=(measured.error / problem.diagonal).reshape(n, m),
        average_error=average,
        maximum_error=maximum,
        history=history_of(carry),
        result=outcome(carry, throw),
        stats={
            "num_steps": carry.step,
            "diagonal": unit.diagonal,
            "unconverged_feet": jnp.sum(~measured.found),
        },
    )


def _checked_grid(grid: ArrayLike, order: tuple[int, int]) -> Any:
    data = as_floating("grid", grid, 3)
    n, m, d = data.shape
    if n < order[0] or m < order[1] or d < 1:
        raise ValueError(
            f"grid must have at least {order[0]} x {order[1]} points for order {tuple(order)}, but has "
            f"shape {data.shape}; give more points or lower the order."
        )
    return data
