r"""The derivative of a fit by the implicit function theorem: $dP = -(\partial G / \partial P)^{-1}\, dG$.

The fit runs on its inputs without their derivatives. Its result then passes through
`with_implicit_derivative`, which leaves it as it is, unless it is differentiated: then the surface is
polished, and the derivative is that of the polished surface in the inputs.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._approximation._polish import PolishedFit, polished
from jaxfit._approximation._stationarity_residual import (
    StationarityResidual,
    feet_in_rows,
    stationarity_residual,
)
from jaxfit._approximation._stationarity_system import StationaritySystem
from jaxfit._cells import Rows
from jaxfit._checks import is_concrete
from jaxfit._closest import as_feet
from jaxfit._compile import compiled
from jaxfit._compile_ahead import is_first
from jaxfit._differentiable_once import differentiated
from jaxfit._fit._adjoints import ImplicitAdjoint
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._method import dynamic_fields
from jaxfit._fit._problem import Problem
from jaxfit._fit._scaling import Unit
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._linear_call import linear_call, transpose_ahead
from jaxfit._precision import default_foot_tolerance, working_dtype
from jaxfit._splines import BSplineSurface
from jaxfit._splines._insertion import insertion_weights
from jaxfit._splines._lookup import windows

# Relative accuracy of the linear system of a derivative, in roots of the rounding unit.
ACCURACY = 0.75
TRUSTED = 1e-3  # a greater |G|, relative to its terms, is of no surface near rest,
RELIABLE = 1e-6  # and from this one on digits are lost

LinearMap = Callable[[Any], tuple[Array, "Fitted"]]
Residual = Callable[[Array, "FitInputs"], tuple[Array, "Fitted"]]


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


class Fitted(eqx.Module):
    """The net, the feet and the diagonal in the user's unit, and |G| over the norms of its terms."""

    net: Float[Any, "nu nv d"]
    u: Float[Any, " points"]
    v: Float[Any, " points"]
    error: Float[Any, " points"]
    diagonal: Float[Any, ""]
    stationarity: Float[Any, ""]


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def with_implicit_derivative(
    rest: Any, adjoint: ImplicitAdjoint, fitted: Fitted, end: EndOfFit, inputs: FitInputs
) -> Fitted:
    """`fitted`, with the derivative of the surface at rest in `inputs`.

    `rest` are the static fields of the method.
    """
    return fitted


@partial(with_implicit_derivative.defjvp, symbolic_zeros=True)
def _derivative(rest: Any, adjoint: ImplicitAdjoint, primals: Any, tangents: Any) -> Any:
    _, end, inputs = primals
    at_rest = _at_rest(rest, adjoint, end, inputs)
    _check_at_rest(adjoint, at_rest.stationarity)
    return jax.jvp(partial(_fitted_at_rest, rest, at_rest, end), (inputs,), (_with_zeros(tangents[2]),))


def _with_zeros(tangents: Any) -> Any:
    """Tangents with zeros of NumPy, which compile nothing, for those that are known to be zero."""
    zero = jax.custom_derivatives.SymbolicZero
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype) if isinstance(x, zero) else x, tangents)


def _check_at_rest(adjoint: ImplicitAdjoint, stationarity: Any) -> None:
    """Raise where the derivative would be that of no surface, warn where it is inaccurate; within `jit` the
    number is all there is.
    """
    if not is_concrete(stationarity):
        return
    found, good = float(np.max(np.asarray(stationarity))), adjoint.good(np.asarray(stationarity).dtype)
    if not found <= max(TRUSTED, good):
        raise ArithmeticError(
            f"the fit has no derivative here: after up to {adjoint.polish_steps} Newton steps its surface is "
            f"not at rest (stationarity {found:.1e}, more than {max(TRUSTED, good):.0e}); fit by "
            "OrthogonalDistance with a number as smoothing, take fewer control points, or pass "
            "ImplicitAdjoint(polish_steps=...) with more steps or UnrolledAdjoint()."
        )
    if found > max(RELIABLE, good):
        warnings.warn(
            "the derivative may be far off: the surface is not quite at rest (stationarity "
            f"{found:.1e}, more than {max(RELIABLE, good):.0e}). Compare it with a difference, or fit "
            "by OrthogonalDistance with a number as smoothing.",
            stacklevel=2,
        )


def polished_fitted(rest: Any, adjoint: ImplicitAdjoint, end: EndOfFit, inputs: FitInputs) -> Fitted:
    """The polished fit, with its derivative in the inputs."""
    at_rest = _at_rest(rest, adjoint, end, inputs)
    if not is_concrete(inputs):
        _check_at_rest(adjoint, at_rest.stationarity)
    return _fitted_at_rest(rest, at_rest, end, inputs)


def polish_ahead(
    rest: Any, adjoint: ImplicitAdjoint, end: EndOfFit, inputs: FitInputs, differentiated_too: bool
) -> None:
    """Begin to compile what brings a fit to rest, and the derivative there, all concrete; `end` is where the
    fit begins.
    """
    leaves, tree = jax.tree.flatten((end, inputs))
    if not is_first(rest, tree, tuple(map(jax.typeof, leaves)), differentiated_too):
        return
    args = (rest, *_limits(adjoint, end), end, inputs)
    polished_fit.ahead(*args)
    if differentiated_too:
        at_rest = polished_fit.like_result(*args)
        _linearised.ahead(rest, at_rest, end, inputs)
        fitted, maps = _linearised.like_result(rest, at_rest, end, inputs)
        transpose_ahead(_along, (maps, at_rest.system), inputs, fitted)


def _at_rest(rest: Any, adjoint: ImplicitAdjoint, end: EndOfFit, inputs: FitInputs) -> PolishedFit:
    """`polished_fit` with the numbers of the adjoint: other ones compile nothing."""
    return polished_fit(rest, *_limits(adjoint, end), end, lax.stop_gradient(inputs))


def _limits(adjoint: ImplicitAdjoint, end: EndOfFit) -> tuple[np.ndarray, np.ndarray]:
    """The stationarity to reach, and how many Newton steps may be taken."""
    dtype = end.problem.target.dtype
    return np.asarray(adjoint.goal(dtype), dtype), np.asarray(adjoint.polish_steps, np.int32)


@partial(compiled, kept=True, static_argnums=0)
def polished_fit(rest: Any, goal: Array, most: Array, end: EndOfFit, inputs: FitInputs) -> PolishedFit:
    """`polished`; on a CPU the fits of a batch one after the other."""

    def whole(goal: Array, most: Array, end: EndOfFit, inputs: FitInputs) -> PolishedFit:
        method = eqx.combine(inputs.numbers, rest)
        return polished(method, goal, most, end.problem, end.surface, end.state, end.projection)

    if jax.default_backend() == "cpu":
        whole = jax.custom_batching.sequential_vmap(whole)
    return whole(goal, most, end, inputs)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _fitted_at_rest(rest: Any, at_rest: PolishedFit, end: EndOfFit, inputs: FitInputs) -> Fitted:
    """The polished fit as a function of the inputs."""
    return _fitted(rest, at_rest, end, inputs)


@partial(_fitted_at_rest.defjvp, symbolic_zeros=True)
def _derivative_at_rest(rest: Any, primals: Any, tangents: Any) -> tuple[Fitted, Fitted]:
    at_rest, end, inputs = primals
    fitted, maps = _linearised(rest, at_rest, end, differentiated(inputs))
    return fitted, linear_call(_along, (maps, at_rest.system), _with_zeros(tangents[2]), fitted)


@partial(compiled, kept=True, static_argnums=0)
def _fitted(rest: Any, at_rest: PolishedFit, end: EndOfFit, inputs: FitInputs) -> Fitted:
    """The polished fit."""
    return _residual_at_rest(rest, at_rest, end)(at_rest.net, inputs)[1]


@partial(compiled, static_argnums=0)
def _linearised(
    rest: Any, at_rest: PolishedFit, end: EndOfFit, inputs: FitInputs
) -> tuple[Fitted, tuple[LinearMap, LinearMap]]:
    """The polished fit; and G with the fit as linear maps, of changes of the inputs and of the net.

    All that the derivative needs of the points is computed here, once for both modes.
    """
    residual, net = _residual_at_rest(rest, at_rest, end), at_rest.net
    (_, fitted), along_inputs = jax.linearize(partial(residual, net), inputs)
    _, along_net = jax.linearize(lambda net: residual(net, inputs), net)
    return fitted, (along_inputs, along_net)


def _along(known: tuple[tuple[LinearMap, LinearMap], StationaritySystem], change: FitInputs) -> Fitted:
    """The derivative along a change of the inputs."""
    (along_inputs, along_net), system = known
    right, held = along_inputs(change)
    accuracy = float(jnp.finfo(right.dtype).eps) ** ACCURACY
    move = system.solved_differentiably(lambda x: along_net(x)[0], -right, accuracy)
    return jax.tree.map(jnp.add, held, along_net(move)[1])


def _residual_at_rest(rest: Any, at_rest: PolishedFit, end: EndOfFit) -> Residual:
    """G, and the fit, as functions of the net and the inputs."""
    at_rest, end = lax.stop_gradient(jax.tree.map(jnp.asarray, (at_rest, end)))
    here, system = at_rest.projection, at_rest.system
    surface = end.surface.moved_to(at_rest.net)

    def residual(net: Array, inputs: FitInputs) -> tuple[Array, Fitted]:
        method = eqx.combine(inputs.numbers, rest)
        problem, still = problem_of(end, inputs), base_net_of(end, inputs)
        u, v = (here.u, here.v) if method.finds_feet else given_feet_of(end, inputs)
        feet = feet_in_rows(surface, end.problem, u, v)
        args = (method, end.state, end.surface.moved_to(net), problem, feet)
        found = stationarity_residual(*args, system.free, still)
        return found.value, _outward(end, inputs, at_rest, net, found, feet.rows)

    return residual


def _outward(
    end: EndOfFit,
    inputs: FitInputs,
    at_rest: PolishedFit,
    net: Array,
    found: StationarityResidual,
    rows: Rows,
) -> Fitted:
    """In the user's unit and the order of the points."""
    count, unit = inputs.points.shape[0], end.unit
    number = end.order[jnp.minimum(rows.point, end.order.shape[0] - 1)]
    number = jnp.where(rows.filled, number, count)

    def by_point(x: Array) -> Array:
        return jnp.zeros(count, x.dtype).at[number].set(x, mode="drop")

    moved = net * unit.scale + unit.centre[None, None]
    kept = base_net_of(end, inputs) * unit.scale + unit.centre[None, None]
    if inputs.control_points.shape == net.shape:
        kept = inputs.control_points.astype(net.dtype)  # to the last bit
    net = jnp.where(at_rest.system.free[:, :, None], moved, kept)
    error = by_point(found.error) * unit.scale
    diagonal = problem_of(end, inputs).diagonal * unit.scale
    return Fitted(net, by_point(found.u), by_point(found.v), error, diagonal, at_rest.stationarity)


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
