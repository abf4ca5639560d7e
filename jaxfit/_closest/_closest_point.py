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

from jaxfit._cells import values_at
from jaxfit._checks import as_floating, as_points, check_kind, check_number, is_concrete
from jaxfit._closest._feet import Feet
from jaxfit._closest._implicit import foot_parameters
from jaxfit._closest._project import project
from jaxfit._closest._seeds import Samples, Search, sample
from jaxfit._closest._steps import AbstractFootMethod, Newton
from jaxfit._precision import advise_x64, bucket, default_foot_tolerance
from jaxfit._splines import BSplineCurve, BSplineSurface
from jaxfit._splines._evaluate import evaluate_surface
from jaxfit._splines._pieces import Pieces, as_surface_arrays, make_pieces


class PointStatus(enum.IntEnum):
    """Where a foot point lies, or that it was not found; `ClosestPoint.status` holds these numbers."""

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
    """

    u: Float[Array, " points"]
    v: Float[Array, " points"] | None
    point: Float[Array, "points d"]
    distance: Float[Array, " points"]
    converged: Bool[Array, " points"]
    status: Int[Array, " points"]
    steps: Int[Array, " points"]


def closest_point(
    surface: BSplineSurface | BSplineCurve,
    points: ArrayLike,
    start: Any = None,
    method: AbstractFootMethod | None = None,
    tolerance: float | None = None,
    max_steps: int = 60,
) -> ClosestPoint:
    r"""Foot points: $\arg\min_{u,v} |Q_k - R(u, v)|$ over the domain, for every point $Q_k$.

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
        At least 1. About as many evaluations are spent on a point, from each start and in each of the places
        it is looked for, before it counts as not converged.

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
    borders between smooth parts. Feet that do not converge are looked for on the four border curves
    (section 3.1 of the paper) and say so.

    The global search can miss the nearest foot where samples are very uneven: next to an edge collapsed to a
    point, a few queries in ten thousand. On a surface with a jump (a knot as often as its order) the value
    at the knot is that from the right; a query nearest to the left one is reported as not converged.

    Works under `jit`, `vmap` and `grad`. Inside a transformation the global search is by brute force from
    two starts per point, which is slower and may, where three or more feet compete, miss the nearest. The
    derivative is implicit: $d(u, v) = H^{-1} dg$ with $g$ the orthogonality equations and $H$ the Hessian of
    half the squared distance; a coordinate held at a border does not move, and where $H$ is singular
    (centres of curvature) the derivative is set to zero.

    Outside transformations sizes are padded to one of four per octave, so that clouds of similar size
    share one compilation.
    """
    method = Newton() if method is None else method
    check_kind("surface", surface, (BSplineSurface, BSplineCurve), "BSplineSurface(...)")
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
    if is_concrete(net, knots_u, knots_v, queries, starts, tolerance, max_steps):
        result = _on_host(method, (net, knots_u, knots_v), queries, starts, tolerance, max_steps)
    else:
        result = _traced(method, (net, knots_u, knots_v), queries, starts, tolerance, max_steps)
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


class Prepared(eqx.Module):
    """A surface made ready for many queries: centred pieces, and samples to start from."""

    pieces: Pieces
    centre: Float[Array, " d"]
    samples: Samples | None


@partial(jax.jit, static_argnames="sampled")
def prepare(net: Array, knots_u: Array, knots_v: Array, sampled: bool) -> Prepared:
    """Pieces about the middle of the net, where coordinates carry the least rounding."""
    centre = 0.5 * (jnp.min(net, axis=(0, 1)) + jnp.max(net, axis=(0, 1)))
    pieces = make_pieces(net - centre[None, None, :], knots_u, knots_v)
    return Prepared(pieces, centre, sample(pieces) if sampled else None)


def extent(net: Any, points: Any) -> float:
    """Diagonal of the box around control points and queries (concrete)."""
    net, points = np.asarray(net), np.asarray(points)
    low = np.minimum(net.min(axis=(0, 1)), points.min(axis=0)).astype(np.float64)
    high = np.maximum(net.max(axis=(0, 1)), points.max(axis=0)).astype(np.float64)
    return float(np.linalg.norm(high - low))


@partial(jax.jit, static_argnames="method")
def _run(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Array,
    u: Array,
    v: Array,
    idle: Array,
    tolerance: Array,
    max_steps: Array,
) -> Feet:
    return project(method, pieces, target, u, v, tolerance, max_steps, idle)


@jax.jit
def _describe(
    pieces: Pieces, u: Array, v: Array, converged: Array
) -> tuple[Float[Array, "d points"], Int[Array, " points"]]:
    """Foot points (centred) and their status."""
    curve = pieces.coefficients.shape[-1] == 1
    status = _status(pieces.axis_u.breaks, pieces.axis_v.breaks, u, v, converged, curve)
    return values_at(pieces, u, v), status


def _status(breaks_u: Array, breaks_v: Array, u: Array, v: Array, converged: Array, curve: bool) -> Array:
    at_u = ((u <= breaks_u[0]) | (u >= breaks_u[-1])).astype(jnp.int32)
    at_v = ((v <= breaks_v[0]) | (v >= breaks_v[-1])).astype(jnp.int32)
    return jnp.where(converged, at_u if curve else at_u + at_v, int(PointStatus.NOT_CONVERGED))


def _on_host(
    method: AbstractFootMethod,
    arrays: tuple[Array, Array, Array],
    points: Any,
    start: tuple[Any, Any] | None,
    tolerance: float,
    max_steps: int,
) -> ClosestPoint:
    """Concrete queries: padded to a bucket, global by a k-d tree on the samples if there is no start."""
    net = arrays[0]
    dtype = np.dtype(net.dtype)
    prepared = prepare(*arrays, sampled=start is None)
    count = points.shape[0]
    size = bucket(count)
    centred = np.asarray(points, np.float64) - np.asarray(prepared.centre, np.float64)
    limits = (
        jnp.asarray(tolerance * extent(net, points), dtype),
        jnp.asarray(max_steps, jnp.int32),
    )

    def feet_from(which: Any, u: Any, v: Any) -> dict[str, np.ndarray]:
        """Feet of the points `which`, from (u, v); always the same shapes."""
        target = jnp.asarray(_padded(centred[which], size).T.astype(dtype))
        starts = (jnp.asarray(_padded(np.asarray(x), size).astype(dtype)) for x in (u, v))
        idle = np.arange(size) >= len(u)
        feet = _run(method, prepared.pieces, target, *starts, idle, *limits)
        fields = dict(u=feet.best_u, v=feet.best_v, f=feet.best, ok=feet.converged, n=feet.steps)
        return {name: np.array(x)[: len(u)] for name, x in fields.items()}

    if start is not None:
        best = feet_from(slice(None), *start)
    else:
        best = globally(feet_from, prepared.samples, centred, size)
    padded = (jnp.asarray(_padded(best[name], size)) for name in ("u", "v", "ok"))
    point, status = _describe(prepared.pieces, *padded)
    shifted = np.asarray(point).T[:count] + np.asarray(prepared.centre)
    with np.errstate(invalid="ignore"):
        distance = np.sqrt(best["f"])
    fields = (best["u"], best["v"], shifted, distance)
    flags = (best["ok"], np.asarray(status)[:count], best["n"])
    # Not jnp.asarray, which compiles a copy for every new size.
    return ClosestPoint(*(jax.device_put(x) for x in (*fields, *flags)))


def globally(feet_from: Any, samples: Samples, points: np.ndarray, size: int) -> dict[str, np.ndarray]:
    """The nearest foot of all: from the nearest sample, then from every rival that is left.

    `feet_from(which, u, v)` gives the feet of some points from starts, at most `size` at a time.
    """
    search = Search(samples, points)
    best = feet_from(slice(None), *search.nearest())
    distance = np.sqrt(best["f"].astype(np.float64))
    rivals = search.rivals(best["u"], best["v"], distance)
    which, u, v = rivals.first()
    if which.size:
        other = feet_from(which, u, v)
        everywhere_u, everywhere_v = best["u"].copy(), best["v"].copy()
        everywhere_u[which], everywhere_v[which] = other["u"], other["v"]
        rivals.found(everywhere_u, everywhere_v)
        _take_nearer(best, which, other)
    which, u, v = rivals.rest()
    for begin in range(0, which.size, size):
        part = slice(begin, begin + size)
        _take_nearer(best, which[part], feet_from(which[part], u[part], v[part]))
    return best


def _take_nearer(best: dict[str, np.ndarray], which: np.ndarray, other: dict[str, np.ndarray]) -> None:
    """Replace feet by nearer ones; `which` may name a point several times."""
    np.add.at(best["n"], which, other["n"])
    # Of each point's, the converged ones first and of these the nearest.
    order = np.lexsort((other["f"], ~other["ok"], which))
    first = order[np.unique(which[order], return_index=True)[1]]
    mine = which[first]
    nearer = other["f"][first] < best["f"][mine]
    nearer &= other["ok"][first] | ~best["ok"][mine]
    for name in ("u", "v", "f", "ok"):
        best[name][mine[nearer]] = other[name][first[nearer]]


def _padded(x: np.ndarray, size: int) -> np.ndarray:
    """Rows repeated at the end up to `size`."""
    return np.concatenate([x, np.repeat(x[-1:], size - len(x), axis=0)])


def _traced(
    method: AbstractFootMethod,
    arrays: tuple[Array, Array, Array],
    points: Any,
    start: tuple[Any, Any] | None,
    tolerance: Any,
    max_steps: Any,
) -> ClosestPoint:
    """Queries inside a transformation: one computation, differentiable."""
    net, knots_u, knots_v = arrays
    points = jnp.asarray(points, net.dtype) if is_concrete(points) else points
    dtype = jnp.result_type(net, points)
    points = points.astype(dtype)
    corners = lax.stop_gradient(jnp.concatenate([net.reshape(-1, net.shape[-1]), points]))
    size = jnp.linalg.norm(jnp.max(corners, axis=0) - jnp.min(corners, axis=0))
    if start is not None:
        start = (jnp.asarray(start[0], dtype), jnp.asarray(start[1], dtype))
    limits = (jnp.asarray(tolerance, dtype) * size, jnp.asarray(max_steps, jnp.int32))
    limits = lax.stop_gradient(limits)
    u, v, converged, steps = foot_parameters(
        method, net.astype(dtype), knots_u, knots_v, points, start, *limits
    )
    (point,) = evaluate_surface(net, knots_u, knots_v, u, v, ((0, 0),), False)
    square = jnp.sum((points - point) ** 2, axis=-1)
    apart = square > 0
    distance = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    order_u, order_v = knots_u.shape[0] - net.shape[0], knots_v.shape[0] - net.shape[1]
    ends_u = knots_u[order_u - 1 : knots_u.shape[0] - order_u + 1]
    ends_v = knots_v[order_v - 1 : knots_v.shape[0] - order_v + 1]
    status = _status(ends_u, ends_v, u, v, converged, order_v == 1)
    return ClosestPoint(u, v, point, distance, converged, status, steps)
