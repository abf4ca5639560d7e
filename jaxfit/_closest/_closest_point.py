"""The closest point on a curve or surface, for many points at once."""

import enum
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from jaxfit._checks import (
    as_floating,
    as_points,
    check_kind,
    check_number,
    eager_where_concrete,
    is_concrete,
    without_derivatives,
)
from jaxfit._closest._foot_methods import AbstractFootMethod, Newton
from jaxfit._closest._implicit import Arrays, as_feet, searched_feet
from jaxfit._closest._nearest_feet import nearest_feet
from jaxfit._compile import compiled
from jaxfit._precision import advise_x64, default_foot_tolerance
from jaxfit._progress_line import shows_progress
from jaxfit._splines import BSplineCurve, BSplineSurface
from jaxfit._splines._evaluate import evaluate_surface
from jaxfit._splines._pieces import as_surface_arrays, make_axis
from jaxfit._unrolling import root_with_slope


class PointStatus(enum.IntEnum):
    """Where a foot point lies, or that it was not found; `ClosestPoint.status` holds these numbers.

    Examples
    --------
    >>> jf.PointStatus(1).name
    'BORDER'
    """

    INTERIOR = 0
    BORDER = 1
    CORNER = 2
    NOT_CONVERGED = 3


class ClosestPoint(eqx.Module):
    """Closest points, one entry for each query.

    Attributes
    ----------
    u, v : array (points,)
        Parameters of the foot points; `v` is None for a curve.
    point : array (points, d)
        The foot points R(u, v).
    distance : array (points,)
        |Q - R(u, v)|, in the unit of the coordinates.
    converged : array (points,) of bool
        Whether the residual is orthogonal to the surface, or points out of it on a border, to the tolerance.
    status : array (points,) of int
        A `PointStatus` each.
    steps : array (points,) of int
        Evaluations of the surface spent on each point.

    Examples
    --------
    >>> x, y = np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij")
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> square = jf.BSplineSurface(np.stack([x, y, 0 * x], axis=2), knots, knots)
    >>> found = jf.closest_point(square, np.array([[0.25, 0.5, 2.0], [3.0, 0.5, 0.0]]))
    >>> found.point.shape, found.status.tolist() == [jf.PointStatus.INTERIOR, jf.PointStatus.BORDER]
    ((2, 3), True)
    """

    u: Float[Array, " points"]
    v: Float[Array, " points"] | None
    point: Float[Array, "points d"]
    distance: Float[Array, " points"]
    converged: Bool[Array, " points"]
    status: Int[Array, " points"]
    steps: Int[Array, " points"]


@shows_progress("searching closest points")
@eager_where_concrete
def closest_point(
    surface: BSplineSurface | BSplineCurve,
    points: ArrayLike,
    start: Any = None,
    method: AbstractFootMethod | None = None,
    tolerance: float | None = None,
    max_steps: int = 60,
) -> ClosestPoint:
    r"""Foot points: $\operatorname{argmin}_{u,v} |Q_k - R(u, v)|$ over the domain, for every point $Q_k$.

    Parameters
    ----------
    surface : BSplineSurface or BSplineCurve
        In any dimension d.
    points : array (points, d)
    start : pair of arrays (points,), optional
        Parameters (u, v) to start from (for a curve just u): the result is then the local minimum that the
        iteration runs into; starts outside the domain are moved to its border. Without it the search is
        global: the spline is sampled several times a cell, and every sample that could lead to a nearer
        foot is tried.
    method : Newton() or HuWallner(), optional
        The step (default `Newton()`). Either way a step never increases the distance.
    tolerance : float, optional
        Largest tangential part of the residual, as a fraction of the extent (the diagonal of the box
        around control points and queries). Default 1e-12 in float64, 1e-5 in float32.
    max_steps : int
        At least 1: about how many evaluations of the surface a point gets from each of its starts. One that
        needs more has not converged (default 60).

    Returns
    -------
    ClosestPoint

    Raises
    ------
    ValueError
        If `points` or `start` have the wrong shape or are not finite.

    Notes
    -----
    Newton's method on the squared distance with the domain as bounds (an active set), or the iteration of
    Hu and Wallner (2005). Knots of multiplicity order - 1, where the tangent may jump, are treated as
    borders between smooth parts. Feet that do not converge are searched on the four border curves
    (section 3.1 of the paper) and say so. A foot also counts as found where the last two steps predict, by
    quadratic convergence, a tangential residual below a hundredth of the tolerance, which saves one.

    Of clouds with many points a cell only those are searched for whose first foot is farther than 0.3 times
    the reach of the surface, which is estimated from samples and not proven.

    The global search can miss the nearest foot where samples are very uneven: next to an edge collapsed to a
    point, a few queries in ten thousand. Nor does it tell two feet apart that lie within one and a half of
    its samples (a third of a span each, or less), as on a surface that folds over so tightly. On a surface
    with a jump (a knot as often as its order) the value at the knot is that from the right; a query nearest
    to the left one is reported as not converged.

    Works under `jit`, `vmap` and `grad`. Inside `jit` and `vmap` the global search is by brute force from two
    starts per point, which is slower and may, where three or more feet compete, miss the nearest. The
    derivative is implicit: $d(u, v) = H^{-1} dg$ with $g$ the orthogonality equations and $H$ the Hessian of
    half the squared distance; a coordinate held at a border does not move, and where $H$ is singular
    (centres of curvature) the derivative is set to zero.

    Outside transformations sizes are padded to one of four per octave, so that clouds of similar size
    share one compilation. On a CPU, clouds of more than 32,768 points are cut into parts of one size, a
    thread for each core.

    Examples
    --------
    >>> x, y = np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij")
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> square = jf.BSplineSurface(np.stack([x, y, 0 * x], axis=2), knots, knots)
    >>> found = jf.closest_point(square, np.array([[0.25, 0.5, 2.0], [3.0, 0.5, 0.0]]))
    >>> np.round(found.u, 3).tolist(), np.round(found.v, 3).tolist(), np.round(found.distance, 3).tolist()
    ([0.25, 1.0], [0.5, 0.5], [2.0, 2.0])
    """
    method = Newton() if method is None else method
    check_kind("surface", surface, (BSplineSurface, BSplineCurve), "fit.surface")
    check_kind("method", method, AbstractFootMethod, "Newton()")
    check_number("max_steps", max_steps, 1, whole=True)
    if tolerance is not None:
        check_number("tolerance", tolerance, 0.0)
    net, knots_u, knots_v = as_surface_arrays(surface)
    queries = as_points("points", points, net.shape[-1])
    starts = _checked_start(start, queries.shape[0], isinstance(surface, BSplineCurve))
    if tolerance is None:
        tolerance = default_foot_tolerance(net.dtype)
    elif is_concrete(tolerance):
        advise_x64(float(tolerance), net.dtype)
    given = (net, knots_u, knots_v), queries, starts, tolerance, max_steps
    values = without_derivatives(given)
    if is_concrete(given):
        result = _on_host(method, *given)
    else:
        queries = jnp.asarray(queries, net.dtype) if is_concrete(queries) else queries
        if is_concrete(values):  # under `grad` alone
            result = _followed(_on_host(method, *values), given[0], queries, tolerance)
        else:
            result = _traced(method, given[0], queries, *given[2:])
    if isinstance(surface, BSplineCurve):
        result = eqx.tree_at(lambda x: x.v, result, None)
    return result


def _checked_start(start: Any, count: int, curve: bool) -> tuple[Any, Any] | None:
    if start is None:
        return None
    if curve:
        u = start[0] if isinstance(start, tuple) else start
        start = (u, np.zeros(np.shape(u)))
    if not isinstance(start, (tuple, list)) or len(start) != 2:
        raise ValueError("start must be a pair (u, v) of parameter arrays; pass start=(u, v).")
    checked = []
    for name, x in zip(("start u", "start v"), start, strict=True):
        x = as_floating(name, x, 1)
        if x.shape[0] != count:
            raise ValueError(
                f"{name} must hold one parameter for each of the {count} points, but has shape "
                f"{x.shape}; give both starts per point."
            )
        checked.append(x)
    return checked[0], checked[1]


def _status(breaks_u: Any, breaks_v: Any, u: Any, v: Any, converged: Any, curve: bool) -> Any:
    at_u = ((u <= breaks_u[0]) | (u >= breaks_u[-1])).astype(np.int32)
    at_v = ((v <= breaks_v[0]) | (v >= breaks_v[-1])).astype(np.int32)
    xp: Any = np if is_concrete(u, v, converged) else jnp
    return xp.where(converged, at_u if curve else at_u + at_v, np.int32(PointStatus.NOT_CONVERGED))


def _on_host(
    method: AbstractFootMethod,
    arrays: Arrays,
    points: Any,
    start: tuple[Any, Any] | None,
    tolerance: float,
    max_steps: int,
) -> ClosestPoint:
    net, knots_u, knots_v = arrays
    orders = knots_u.shape[0] - net.shape[0], knots_v.shape[0] - net.shape[1]
    axes = make_axis(knots_u, orders[0]), make_axis(knots_v, orders[1])
    best = nearest_feet(
        method, net, *axes, np.asarray(points), start=start, tolerance=tolerance, max_steps=max_steps
    )
    u, v, distance, converged = (best[name] for name in ("u", "v", "distance", "converged"))
    status = _status(axes[0].breaks, axes[1].breaks, u, v, converged, orders[1] == 1)
    # Not jnp.asarray, which compiles a copy for every new size.
    return ClosestPoint(*jax.device_put((u, v, best["point"], distance, converged, status, best["steps"])))


@partial(compiled, static_argnums=0)
def _traced(
    method: AbstractFootMethod,
    arrays: Arrays,
    points: Any,
    start: tuple[Any, Any] | None,
    tolerance: Any,
    max_steps: Any,
) -> ClosestPoint:
    """Queries inside a transformation: one computation, differentiable."""
    dtype = jnp.result_type(arrays[0], points)
    arrays, points = (arrays[0].astype(dtype), *arrays[1:]), points.astype(dtype)
    if start is not None:
        start = (jnp.asarray(start[0], dtype), jnp.asarray(start[1], dtype))
    arrays, points, unit, length = _in_unit(arrays, points, tolerance)
    limits = length, jnp.asarray(max_steps, jnp.int32)
    u, v, converged, steps = searched_feet(method, arrays, points, start, *limits)
    return _at_feet((u, v), converged, steps, arrays, points, length, unit)


@compiled
def _followed(found: ClosestPoint, arrays: Arrays, points: Any, tolerance: Any) -> ClosestPoint:
    """`found` as a function of surface and points."""
    arrays, points, unit, length = _in_unit(arrays, points, tolerance)
    return _at_feet((found.u, found.v), found.converged, found.steps, arrays, points, length, unit)


def _in_unit(arrays: Arrays, points: Array, tolerance: Any) -> tuple[Arrays, Array, Array, Array]:
    """Surface and points in a unit near their extent, that unit, and the tolerance in it.

    In single precision squares of very small or large lengths would be 0 or infinite. The unit is a power of
    two, so that nothing is rounded.
    """
    net, knots_u, knots_v = arrays
    corners = lax.stop_gradient(jnp.concatenate([net.reshape(-1, net.shape[-1]), points]))
    box = jnp.max(corners, axis=0) - jnp.min(corners, axis=0)
    unit = lax.reduce_precision(jnp.max(box), jnp.finfo(box.dtype).nexp, 0)
    unit = lax.select((unit > 0) & (unit < jnp.inf), unit, np.ones((), box.dtype))
    length = lax.stop_gradient(jnp.asarray(tolerance, box.dtype) * jnp.linalg.norm(box / unit))
    return (net / unit, knots_u, knots_v), points / unit, unit, length


def _at_feet(
    feet: Any, converged: Array, steps: Array, arrays: Arrays, points: Array, tolerance: Array, unit: Array
) -> ClosestPoint:
    """What there is at known feet, which follow surface and points; these and the tolerance are in `unit`,
    the result is not.
    """
    net, knots_u, knots_v = arrays
    u, v = as_feet(feet, arrays, points, tolerance)
    (point,) = evaluate_surface(net, knots_u, knots_v, u, v, ((0, 0),), False)
    distance = root_with_slope(jnp.sum((points - point) ** 2, axis=-1))
    order_u, order_v = knots_u.shape[0] - net.shape[0], knots_v.shape[0] - net.shape[1]
    ends_u = knots_u[order_u - 1 : knots_u.shape[0] - order_u + 1]
    ends_v = knots_v[order_v - 1 : knots_v.shape[0] - order_v + 1]
    status = _status(ends_u, ends_v, u, v, converged, order_v == 1)
    return ClosestPoint(u, v, point * unit, distance * unit, converged, status, steps)
