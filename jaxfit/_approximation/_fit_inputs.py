"""What a fit is differentiated in, where it ended, and its problem as a function of its inputs."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._checks import is_concrete
from jaxfit._closest import as_feet
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._method_fields import dynamic_fields
from jaxfit._fit._problem import Problem
from jaxfit._fit._scaling import Unit
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._precision import default_foot_tolerance, working_dtype
from jaxfit._splines import BSplineSurface
from jaxfit._splines._insertion import insertion_weights
from jaxfit._splines._lookup import windows


class FitInputs(eqx.Module):
    """What a fit is differentiated with respect to, in the user's unit; `numbers` are those of the method."""

    points: Float[Array, "points d"]
    weights: Float[Array, " points"] | None
    numbers: Any
    control_points: Float[Array, "nu nv d"]
    start: tuple[Array, Array] | None

    @staticmethod
    def of(cloud: Any, base: BSplineSurface, method: Any, request: dict[str, Any]) -> "FitInputs":
        """Of the arguments of `approximate`, in the working precision."""
        dtype = working_dtype()
        numbers, _ = dynamic_fields(method)
        numbers = jax.tree.map(
            lambda x: jnp.asarray(x, dtype) if is_concrete(x) else x.astype(dtype), numbers
        )
        weights, start = request["weights"], request["start"]
        return FitInputs(
            jnp.asarray(cloud, dtype),
            None if weights is None else jnp.asarray(weights, dtype),
            numbers,
            jnp.asarray(base.control_points, dtype),
            None if start is None else (jnp.asarray(start[0], dtype), jnp.asarray(start[1], dtype)),
        )


class EndOfFit(eqx.Module):
    """Where a fit ended, or for `UnrolledAdjoint` where it is about to begin: in the unit of the problem, its
    points indexed by `order`.
    """

    problem: Problem
    surface: WorkingSurface
    state: Any
    projection: FootPoints
    order: Int[Any, " points"]
    unit: Unit
    knots: tuple[Any, Any]  # of the base surface


def problem_of(end: EndOfFit, inputs: FitInputs) -> Problem:
    """The problem as a function of the inputs. The diagonal follows the points; scale and centre need not."""
    unit, problem = end.unit, end.problem
    inner = (inputs.points - unit.centre[None]) / unit.scale
    spare = end.order.shape[0] - inner.shape[0]
    target = jnp.pad(inner.astype(problem.target.dtype).T, ((0, 0), (0, spare)), mode="edge")[:, end.order]
    weight = problem.weight
    if inputs.weights is not None:
        weight = jnp.pad(inputs.weights.astype(weight.dtype), (0, spare))[end.order]
    counted = (weight > 0)[None]
    low, high = (
        pick(jnp.where(counted, target, sign * jnp.inf), axis=1)
        for pick, sign in ((jnp.min, 1.0), (jnp.max, -1.0))
    )
    diagonal = jnp.sqrt(jnp.sum((high - low) ** 2))
    return eqx.tree_at(lambda p: (p.target, p.weight, p.diagonal), problem, (target, weight, diagonal))


def base_net_of(end: EndOfFit, inputs: FitInputs) -> Float[Array, "nu nv d"]:
    """The base surface on the knots of the final one, in the unit of the problem."""
    net = (inputs.control_points - end.unit.centre[None, None]) / end.unit.scale
    net = net.astype(end.surface.control_points.dtype)
    if net.shape == end.surface.control_points.shape:
        return net
    for old, new in zip(end.knots, (end.surface.knots_u, end.surface.knots_v), strict=True):
        first, weights = insertion_weights(old, new, old.shape[0] - net.shape[0])
        near = windows(net, first, weights.shape[0])
        moved = jnp.einsum("ri...,ri->i...", near, weights, precision=lax.Precision.HIGHEST)
        net = jnp.swapaxes(moved, 0, 1)
    return net


def given_feet_of(end: EndOfFit, inputs: FitInputs) -> tuple[Array, Array]:
    """The parameters that the fit was given, or those of the closest points on the base surface."""
    feet = end.projection.u, end.projection.v
    spare = end.order.shape[0] - inputs.points.shape[0]
    if inputs.start is not None:
        u, v = (jnp.pad(x, (0, spare), mode="edge")[end.order] for x in inputs.start)
        return u.astype(feet[0].dtype), v.astype(feet[0].dtype)
    problem = problem_of(end, inputs)
    tolerance = default_foot_tolerance(feet[0].dtype) * problem.diagonal
    net = (inputs.control_points - end.unit.centre[None, None]) / end.unit.scale
    return as_feet(feet, (net, *end.knots), problem.target.T, tolerance)
