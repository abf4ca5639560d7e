"""`interpolate`: a surface through all points of a grid."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxfit._checks import (
    as_floating,
    check_kind,
    check_magnitude,
    check_number,
    check_progress,
    check_steps,
    check_switch,
    checked_order,
    eager_where_concrete,
    has_coordinates_first,
    is_concrete,
)
from jaxfit._fit._result import Fit, Name, converged_or_raise
from jaxfit._fit._scaling import unit_of
from jaxfit._interpolation._geometric import GeometricInterpolation
from jaxfit._interpolation._hermite import NormalInterpolation
from jaxfit._interpolation._method import CORNERS, AbstractInterpolation, Frame, GridProblem, Progress
from jaxfit._precision import interpolation_tolerance, working_dtype
from jaxfit._progress_line import shows_progress
from jaxfit._scan import check_measured

METHODS = "GeometricInterpolation(), StandardInterpolation() or NormalInterpolation()"


@shows_progress("interpolating a grid")
@eager_where_concrete
def interpolate(
    grid: Any,
    method: AbstractInterpolation | None = None,
    order: int | tuple[int, int] = (4, 4),
    tolerance: ArrayLike | None = None,
    max_steps: int = 1000,
    progress: Progress | None = None,
    throw: bool = False,
    normals: ArrayLike | None = None,
) -> Fit:
    """A B-spline surface through every point of a grid, with one control point for each.

    With `normals` it has four for each, and the given normals besides.

    Parameters
    ----------
    grid : array (n, m, d)
        Any unit; at least `order` points in each direction. Or what `jaxfit.io.read_points` has read, if that
        is a grid.
    method : GeometricInterpolation(), StandardInterpolation() or NormalInterpolation(), optional
        Default `GeometricInterpolation()`, or `NormalInterpolation()` where there are normals: it alone meets
        them, and needs them.
    order : (K, L) or int
        Degree + 1 along the first and the second index, each 2 to 8; one number is that of both.
    tolerance : float, optional
        The largest error allowed, as a fraction of the diagonal of the data's bounding box. Default
        1e-12 in float64, 2e-6 in float32, and more where the data is so far from the origin that rounding its
        coordinates costs more: `fit.stats["tolerance"]`.
    max_steps : int
        Most iterations (of `StandardInterpolation`, cycles of GMRES; `NormalInterpolation` has none).
    progress : callable, optional
        Called as `progress(step, max_steps, average, maximum)` every now and then, outside transformations;
        errors are fractions of the diagonal. Only by `GeometricInterpolation`; the others are done in one go.
    throw : bool
        Raise a RuntimeError with the reason instead of returning a fit that has not converged.
    normals : array (n, m, 3), optional
        Unit normals of the surface at the points; only with `NormalInterpolation`, and always with it.

    Returns
    -------
    Fit
        `u`, `v` and `errors` have the shape (n, m) of the grid.

    Raises
    ------
    ValueError
        If the grid has the wrong shape, too few points, entries that are not finite, or no extent; or
        normals do not fit the grid, are no unit vectors, are given to a method that does not meet them, or
        are missing for the one that does.

    Notes
    -----
    Sections 2.2 and 3 of Kineri, Wang, Lin and Maekawa (2012). Runs under `jit`, `vmap` and `grad`: the
    surface and the feet have derivatives in the data, errors have none. On a closed grid (first row equal to
    the last) the feet stay on their side of the seam. With `symmetry`, fractions are of the diagonal of the
    data as given. A grid in single precision is fitted in double precision if the session has that.

    Examples
    --------
    >>> import jaxfit as jf
    >>> import numpy as np
    >>> x, y = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 5), indexing="ij")
    >>> grid = np.stack([x, y, 0.1 * np.sin(3 * x) * y], axis=-1)
    >>> fit = jf.interpolate(grid)
    >>> bool(fit.converged), fit.surface.shape
    (True, (6, 5))
    >>> bool(np.allclose(fit.surface(fit.u, fit.v), grid, atol=1e-5))
    True
    """
    check_switch("throw", throw)
    check_progress(progress)
    order = checked_order(order)
    check_steps("max_steps", max_steps)
    if tolerance is not None:
        check_number("tolerance", tolerance, 0.0)
    data = _checked_grid(grid, order)
    if method is None:
        method = GeometricInterpolation() if normals is None else NormalInterpolation()
    check_kind("method", method, AbstractInterpolation, METHODS)
    normals = method.check_normals(normals, data, order)
    fit = method.fit(_scaled(data, normals, order, tolerance, max_steps), progress)
    fit = dataclasses.replace(fit, stats={"method": Name(type(method).__name__), **fit.stats})
    return converged_or_raise(fit) if throw else fit


def _scaled(data: Any, normals: Any, order: tuple[int, int], tolerance: Any, max_steps: int) -> GridProblem:
    """The problem in its own unit."""
    unit = unit_of(data.reshape(-1, data.shape[2]), "points of grid")
    dtype = working_dtype()
    goal, tolerance = interpolation_tolerance(tolerance, dtype, unit.least_tolerance(dtype))
    xp: Any = np if is_concrete(data, goal, tolerance) else jnp
    diagonal, goal, tolerance = (xp.asarray(x, dtype) for x in (unit.diagonal / unit.scale, goal, tolerance))
    inner, corners = unit.inward(data).astype(dtype), data[CORNERS].astype(dtype)
    if normals is not None:
        normals = np.asarray(normals, dtype) if is_concrete(normals) else normals.astype(dtype)
    frame = Frame(unit.within(dtype), corners, diagonal, goal, tolerance, np.int32(max_steps))
    return GridProblem(inner, normals, frame, unit, order)


def _checked_grid(grid: Any, order: tuple[int, int]) -> Any:
    if hasattr(grid, "cloud"):
        if grid.grid is None:
            raise ValueError(
                f"grid must be one, but {grid.name} holds {len(grid.cloud):,} scattered points; fit them by "
                "fit_points, or say their rows and columns by as_grid(n, m)."
            )
        grid = grid.grid
    data = as_floating("grid", grid, 3)
    n, m, d = data.shape
    if n < order[0] or m < order[1] or d < 1:
        first = has_coordinates_first(data.shape)
        advice = "pass np.moveaxis(grid, 0, -1)" if first else "give more points or lower the order"
        raise ValueError(
            f"grid must have at least {order[0]} x {order[1]} points for order {order}, but has "
            f"shape {data.shape}; {advice}."
        )
    if not is_concrete(data):
        return data.astype(working_dtype())
    whole = np.asarray(data)  # NumPy's arrays cost no calls of their own
    check_magnitude("grid", whole)
    check_measured("grid", whole.reshape(-1, d), "fit what is left by fit_points, as a cloud")
    return whole
