"""`fit_sharded_cloud`: one fit of a cloud that is divided among devices.

Each device has the rows of its own points; the net is the same on all of them. What an iteration needs of all
points are sums of the size of the net, which `Problem.total` adds up.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxfit._approximation._checked_arguments import (
    check_options,
    check_start_range,
    check_weight_range,
    checked_start,
    checked_weights,
)
from jaxfit._approximation._cloud_fit import (
    LEAST_POINTS,
    final_code,
    fitted_surface,
    order_by_cell,
    stats_of,
    tolerances_of,
    working_surface,
)
from jaxfit._approximation._errors import GlobalFeet
from jaxfit._approximation._methods_by_sums import ON_DEVICES, by_sums
from jaxfit._approximation._shards import divided_over, local_rows, with_local_rows
from jaxfit._checks import as_points, check_kind, is_concrete
from jaxfit._closest import closest_point
from jaxfit._compile import compiled
from jaxfit._fit._history import ErrorHistory, public_history
from jaxfit._fit._loop import begin, iterate
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._method_fields import static_and_numbers
from jaxfit._fit._problem import MeshAxis, Tolerances, make_problem
from jaxfit._fit._reasons import result_of
from jaxfit._fit._result import Fit, converged_or_raise
from jaxfit._fit._scaling import Unit, unit_of
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._precision import working_dtype
from jaxfit._splines import BSplineSurface

WHERE = "where points are divided among devices"


class EndOfShardedFit(eqx.Module):
    """What is the same on all devices when a fit has ended."""

    surface: WorkingSurface
    history: ErrorHistory
    step: Array
    code: Array
    stats: dict[str, Any]


def fit_sharded_cloud(
    points: Any, base: BSplineSurface, method: AbstractIterativeMethod, request: dict[str, Any]
) -> Fit:
    """`approximate` of points divided among devices, its options in a dictionary."""
    summed = _checked_method(points, base, method, request)
    weights, start = _checked_rows(points, base, request["weights"], request["start"])
    mesh, axis = divided_over(points)  # type: ignore[misc]
    weights = jax.device_put(weights, NamedSharding(mesh, P(axis)))
    unit = _checked_unit(mesh, axis, points, weights)
    feet = _first_feet(points, base, start)
    tolerances = tolerances_of(request["tol_average"], request["tol_maximum"], request["max_steps"])
    begun = working_surface(base, unit, True)
    (u, v, error, converged), end = run_on_devices(
        *(static_and_numbers(summed)[0], mesh, axis, request["max_steps"]),
        *(static_and_numbers(summed)[1], points, weights, *feet, unit, tolerances, begun),
    )
    end = jax.tree.map(np.asarray, end)
    surface = fitted_surface(end.surface, base, begun, unit)
    known = local_rows(u), local_rows(v), local_rows(error) * unit.scale, local_rows(converged)
    errors = GlobalFeet() if request["errors"] is None else request["errors"]
    u, v, distance, converged = errors.feet(surface, local_rows(points), known, summed.finds_feet)
    rounding = unit.loss(np.asarray(surface.control_points))
    parts = (u, v, np.asarray(distance) / unit.diagonal + rounding, np.asarray(converged))
    u, v, relative, converged = (with_local_rows(np.asarray(x), points) for x in parts)
    average, maximum, unconverged = jax.tree.map(
        np.asarray, _averages(mesh, axis, relative, weights, converged)
    )
    fit = Fit(
        surface=surface,
        u=u,
        v=v,
        errors=relative,
        average_error=jax.device_put(average),
        maximum_error=jax.device_put(maximum),
        history=public_history(end.history, end.step, getattr(method, "fairing", None)),
        result=result_of(final_code(end.code, (average, maximum), rounding, tolerances)),
        stats=stats_of(method, tolerances, end.step, unit, unconverged) | end.stats,
    )
    return converged_or_raise(fit) if request["throw"] else fit


def _checked_method(
    points: jax.Array, base: BSplineSurface, method: AbstractIterativeMethod, request: dict[str, Any]
) -> AbstractIterativeMethod:
    """The method by sums; raises if an argument is not valid that says nothing about single points."""
    names = ("tol_average", "tol_maximum", "max_steps", "progress", "throw", "errors")
    check_kind("base", base, BSplineSurface, "base_surface(boundary)")
    check_options(method, *(request[name] for name in names))
    shape = jax.ShapeDtypeStruct(points.shape, points.dtype)
    jax.eval_shape(lambda x: as_points("points", x, base.dimension, LEAST_POINTS), shape)
    for name in ("adjoint", "progress"):
        if request[name] is not None:
            raise ValueError(f"{name} must be None {WHERE}; leave it out, or pass points of one device.")
    if not is_concrete(base, method, request):
        raise TypeError(
            f"all arguments must be concrete {WHERE}, but one is traced; call approximate outside "
            "transformations."
        )
    return by_sums(method, ON_DEVICES, WHERE)


def _checked_rows(points: jax.Array, base: BSplineSurface, weights: Any, start: Any) -> tuple[Any, Any]:
    """Weights, and the feet to start from or None; of what is divided only the shapes have been checked."""
    count = points.shape[0]
    if weights is None:
        weights = np.ones(count)
    elif divided_over(weights) is None:
        weights = checked_weights(weights, count)
    else:
        weights = weights.astype(jax.eval_shape(lambda x: checked_weights(x, count), weights).dtype)
    if _are_divided(start):
        jax.eval_shape(lambda *x: checked_start(x, count, base.domain), *start)
    elif start is not None:
        start = checked_start(start, count, base.domain)
    return weights, start


def _are_divided(start: Any) -> bool:
    return isinstance(start, (tuple, list)) and all(divided_over(x) is not None for x in start)


def _checked_unit(mesh: Mesh, axis: MeshAxis, points: jax.Array, weights: jax.Array) -> Unit:
    """The unit of the points of positive weight; raises unless all numbers are valid."""
    bad, box, least, most = (np.asarray(x) for x in _extent(mesh, axis, points, weights))
    if bad:
        raise ValueError(
            f"points and weights must be finite, but {int(bad)} points have an entry that is not; remove or "
            "repair them."
        )
    check_weight_range(least, most)
    return unit_of(np.stack([box[0], -box[1]]), "points")


@partial(compiled, static_argnums=(0, 1))
def _extent(mesh: Mesh, axis: MeshAxis, points: Array, weights: Array) -> tuple[Array, Array, Array, Array]:
    """How many points are not finite; the low corner and minus the high one; least and greatest weight."""

    def own(points: Array, weights: Array) -> tuple[Array, Array, Array, Array]:
        bad = ~(jnp.all(jnp.isfinite(points), axis=1) & jnp.isfinite(weights))
        ends = jnp.where((weights > 0)[None, :, None], jnp.stack([points, -points]), jnp.inf)
        low = lax.pmin(jnp.min(ends, axis=1), axis)
        weight = lax.pmin(jnp.stack([jnp.min(weights), -jnp.max(weights)]), axis)
        return lax.psum(jnp.sum(bad), axis), low, weight[0], -weight[1]

    return jax.shard_map(own, mesh=mesh, in_specs=(P(axis), P(axis)), out_specs=P())(points, weights)


def _first_feet(points: jax.Array, base: BSplineSurface, start: Any) -> tuple[jax.Array, jax.Array]:
    """The feet to start from: those given, or each process finds the closest points of its own."""
    if start is not None:
        u, v = start
        if _are_divided(start):
            ends = np.asarray(_ends(u, v))
            for name, (least, most), limits in zip("uv", ends, base.domain, strict=True):
                check_start_range(name, least, most, limits)
        sharding = NamedSharding(points.sharding.mesh, P(points.sharding.spec[0]))  # type: ignore[attr-defined]
        return jax.device_put(u, sharding), jax.device_put(v, sharding)
    nearest = closest_point(base, local_rows(points))
    u, v = (with_local_rows(np.asarray(x, working_dtype()), points) for x in (nearest.u, nearest.v))
    return u, v


@compiled
def _ends(u: Array, v: Array) -> Array:
    """The least and the greatest u, and v."""
    return jnp.stack([jnp.stack([jnp.min(x), jnp.max(x)]) for x in (u, v)])


@partial(compiled, static_argnums=(0, 1, 2, 3))
def run_on_devices(
    rest: Any,
    mesh: Mesh,
    axis: MeshAxis,
    max_steps: int,
    numbers: Any,
    points: Array,
    weights: Array,
    u: Array,
    v: Array,
    unit: Unit,
    tolerances: Tolerances,
    begun: WorkingSurface,
) -> tuple[tuple[Array, Array, Array, Array], EndOfShardedFit]:
    """The whole loop: u, v, error and converged of every point, and what is the same on all devices."""

    def own(numbers: Any, points: Array, weights: Array, u: Array, v: Array, *same: Any) -> Any:
        unit, tolerances, begun = same
        dtype = working_dtype()
        method = eqx.combine(numbers, rest)
        order = order_by_cell(begun, u, v, u.shape[0])
        problem = make_problem(points.astype(dtype), weights, unit, tolerances, padded=False, axis=axis)
        problem = problem.ordered(order)
        loop = begin(method, problem, begun, u.astype(dtype)[order], v.astype(dtype)[order], max_steps)
        loop, stats = iterate(rest, numbers, problem, tolerances.max_steps, loop)
        last, back = loop.current, jnp.argsort(order)
        here = last.projection
        feet = tuple(x[back] for x in (here.u, here.v, here.error, here.converged))
        return feet, EndOfShardedFit(last.surface, loop.history, last.step, loop.code, stats)

    specs = (P(), *(P(axis),) * 4, P(), P(), P())
    shared = jax.shard_map(own, mesh=mesh, in_specs=specs, out_specs=(P(axis), P()))
    return shared(numbers, points, weights, u, v, unit, tolerances, begun)


@partial(compiled, static_argnums=(0, 1))
def _averages(
    mesh: Mesh, axis: MeshAxis, relative: Array, weights: Array, converged: Array
) -> tuple[Array, Array, Array]:
    """Average and maximum error over the points of positive weight, and how many feet are not converged."""

    def own(relative: Array, weights: Array, converged: Array) -> tuple[Array, Array, Array]:
        errors = jnp.where(weights > 0, relative, 0.0)
        sums = jnp.sum(errors), jnp.sum(weights > 0), jnp.sum(~converged)
        total, counted, unconverged = lax.psum(sums, axis)
        return total / counted, lax.pmax(jnp.max(errors), axis), unconverged

    return jax.shard_map(own, mesh=mesh, in_specs=P(axis), out_specs=P())(relative, weights, converged)
