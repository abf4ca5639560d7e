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
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._fit_inputs import (
    EndOfFit,
    FitInputs,
    base_net_of,
    given_feet_of,
    problem_of,
)
from jaxfit._approximation._linearisation import Linearisation
from jaxfit._approximation._polish import Polish, PolishedFit, polish_ahead, polished
from jaxfit._approximation._stationarity_residual import (
    FeetInRows,
    StationarityResidual,
    feet_at,
    stationarity_residual,
)
from jaxfit._cells import Rows
from jaxfit._checks import is_concrete
from jaxfit._compile import compiled
from jaxfit._compile_ahead import is_first
from jaxfit._differentiable_once import differentiated
from jaxfit._fit._adjoints import ImplicitAdjoint
from jaxfit._linear_call import linear_call, transpose_ahead

# Relative accuracy of the linear system of a derivative, in roots of the rounding unit.
ACCURACY = 0.75
TRUSTED = 1e-3  # a greater |G|, relative to its terms, is of no surface near rest,
RELIABLE = 1e-6  # and from this one on digits are lost

LinearMap = Callable[[Any], tuple[Array, "Fitted"]]
Residual = Callable[[FitInputs], tuple[Array, "Fitted"]]


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
    return _fitted_and_change(rest, adjoint, at_rest, end, inputs, tangents[2])


def _with_zeros(tangents: Any) -> Any:
    """Tangents with zeros of NumPy, which compile nothing, for those that are known to be zero."""
    zero = jax.custom_derivatives.SymbolicZero
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype) if isinstance(x, zero) else x, tangents)


def _check_at_rest(adjoint: ImplicitAdjoint, stationarity: Any) -> None:
    """Raise where the derivative would be that of no surface, warn where it is inaccurate; within `jit` it is
    NaN there.
    """
    if not is_concrete(stationarity):
        return
    found, dtype = float(np.max(np.asarray(stationarity))), np.asarray(stationarity).dtype
    good, most = adjoint.good(dtype), _trusted(adjoint, dtype)
    if not found <= most:
        raise ArithmeticError(
            f"the fit has no derivative here: after up to {adjoint.polish_steps} Newton steps its surface is "
            f"not at rest (stationarity {found:.1e}, more than {most:.0e}); fit by "
            "OrthogonalDistance with a number as smoothing, or a greater one, raise max_steps, take fewer "
            "control points, or pass ImplicitAdjoint(polish_steps=...) with more steps or UnrolledAdjoint()."
        )
    if found > max(RELIABLE, good):
        warnings.warn(
            "the derivative may be far off: the surface is not quite at rest (stationarity "
            f"{found:.1e}, more than {max(RELIABLE, good):.0e}). Compare it with a difference, or fit "
            "by OrthogonalDistance with a number as smoothing.",
            stacklevel=2,
        )


def _trusted(adjoint: ImplicitAdjoint, dtype: Any) -> float:
    return max(TRUSTED, adjoint.good(dtype))


def polished_fitted(rest: Any, adjoint: ImplicitAdjoint, end: EndOfFit, inputs: FitInputs) -> Fitted:
    """The polished fit, with its derivative in the inputs."""
    at_rest = _at_rest(rest, adjoint, end, inputs)
    if not is_concrete(inputs):
        _check_at_rest(adjoint, at_rest.stationarity)
    return _fitted_at_rest(rest, adjoint, at_rest, end, inputs)


def derivative_ahead(
    rest: Any, adjoint: ImplicitAdjoint, end: EndOfFit, inputs: FitInputs, differentiated_too: bool
) -> None:
    """Begin to compile what brings a fit to rest, and the derivative there, all concrete; `end` is where the
    fit begins.
    """
    leaves, tree = jax.tree.flatten((end, inputs))
    if not is_first(rest, tree, tuple(map(jax.typeof, leaves)), differentiated_too):
        return
    at_rest = polish_ahead(rest, _polish_of(adjoint, end, inputs))
    if differentiated_too:
        args = rest, _resting(at_rest), end, inputs
        _along_inputs.ahead(*args)
        fitted, along, order = _along_inputs.like_result(*args)
        transpose_ahead(_along, (along, order, at_rest.near), inputs, fitted)


def _at_rest(rest: Any, adjoint: ImplicitAdjoint, end: EndOfFit, inputs: FitInputs) -> PolishedFit:
    return polished(rest, _polish_of(adjoint, end, lax.stop_gradient(inputs)))


def _polish_of(adjoint: ImplicitAdjoint, end: EndOfFit, inputs: FitInputs) -> Polish:
    """With the numbers of the adjoint as arrays: other ones compile nothing."""
    dtype = end.problem.target.dtype
    goal, most = np.asarray(adjoint.goal(dtype), dtype), np.asarray(adjoint.polish_steps, np.int32)
    return Polish(inputs.numbers, goal, most, end.problem, end.surface, end.state, end.projection)


class _RestingFit(eqx.Module):
    """Where a fit is at rest: what its derivative needs to know of that."""

    net: Float[Any, "nu nv d"]
    feet: FeetInRows
    free: Bool[Any, "nu nv"]
    stationarity: Float[Any, ""]


def _resting(at_rest: PolishedFit) -> _RestingFit:
    near = at_rest.near
    return _RestingFit(at_rest.net, near.feet, near.system.free, at_rest.stationarity)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _fitted_at_rest(
    rest: Any, adjoint: ImplicitAdjoint, at_rest: PolishedFit, end: EndOfFit, inputs: FitInputs
) -> Fitted:
    """The polished fit as a function of the inputs."""
    return _fitted(rest, _resting(at_rest), end, inputs)


@partial(_fitted_at_rest.defjvp, symbolic_zeros=True)
def _derivative_at_rest(
    rest: Any, adjoint: ImplicitAdjoint, primals: Any, tangents: Any
) -> tuple[Fitted, Fitted]:
    at_rest, end, inputs = primals
    return _fitted_and_change(rest, adjoint, at_rest, end, inputs, tangents[2])


def _fitted_and_change(
    rest: Any,
    adjoint: ImplicitAdjoint,
    at_rest: PolishedFit,
    end: EndOfFit,
    inputs: FitInputs,
    tangents: Any,
) -> tuple[Fitted, Fitted]:
    """The polished fit, and its derivative along a change of the inputs; NaN within `jit` if not at rest."""
    fitted, along, order = _along_inputs(rest, _resting(at_rest), end, differentiated(inputs))
    change = linear_call(_along, (along, order, at_rest.near), _with_zeros(tangents), fitted)
    share = at_rest.stationarity
    if not is_concrete(share):  # otherwise that has been checked
        factor = jnp.where(share <= _trusted(adjoint, share.dtype), 1.0, jnp.nan).astype(share.dtype)
        change = jax.tree.map(lambda x: factor * x, change)  # NaN in both modes
    return fitted, change


@partial(compiled, kept=True, static_argnums=0)
def _fitted(rest: Any, resting: _RestingFit, end: EndOfFit, inputs: FitInputs) -> Fitted:
    """The polished fit."""
    return _residual_at_rest(rest, resting, end)(inputs)[1]


@partial(compiled, optimised=False, static_argnums=0)
def _along_inputs(
    rest: Any, resting: _RestingFit, end: EndOfFit, inputs: FitInputs
) -> tuple[Fitted, LinearMap, "_PointOrder"]:
    """The polished fit; G with the fit as a linear map of changes of the inputs; and where points are."""
    residual = _residual_at_rest(rest, resting, end)
    (_, fitted), along = jax.linearize(residual, inputs)
    return fitted, along, _PointOrder.of(end, resting.feet.rows, inputs.points.shape[0])


def _along(known: tuple[LinearMap, "_PointOrder", Linearisation], change: FitInputs) -> Fitted:
    """The derivative along a change of the inputs."""
    along_inputs, order, near = known
    right, held = along_inputs(change)
    accuracy = float(jnp.finfo(right.dtype).eps) ** ACCURACY
    move = near.system.solved_differentiably(near.change, -right, accuracy)
    count, scale = change.points.shape[0], order.scale
    u, v, error = (order.by_point(x, count) for x in near.along_net(move)[1])
    net, none = jnp.where(near.system.free[:, :, None], scale * move, 0.0), jnp.zeros_like(held.diagonal)
    return jax.tree.map(jnp.add, held, Fitted(net, u, v, scale * error, none, none))


class _PointOrder(eqx.Module):
    """The number of the point in each slot of the rows, and the unit of the fit."""

    number: Int[Any, "rows width"]
    scale: Float[Any, ""]

    @staticmethod
    def of(end: EndOfFit, rows: Rows, count: int) -> "_PointOrder":
        """Empty slots have the number `count`."""
        number = jnp.asarray(end.order)[jnp.minimum(rows.point, end.order.shape[0] - 1)]
        scale = jnp.asarray(end.unit.scale, end.problem.target.dtype)
        return _PointOrder(jnp.where(rows.filled, number, count), scale)

    def by_point(self, x: Float[Array, "rows width"], count: int) -> Float[Array, " points"]:
        """In the order of the points as they were given."""
        return jnp.zeros(count, x.dtype).at[self.number].add(x, mode="drop")


def _residual_at_rest(rest: Any, resting: _RestingFit, end: EndOfFit) -> Residual:
    """G, and the fit, as functions of the inputs."""
    resting, end = lax.stop_gradient(jax.tree.map(jnp.asarray, (resting, end)))
    surface = end.surface.moved_to(resting.net)

    def residual(inputs: FitInputs) -> tuple[Array, Fitted]:
        method = eqx.combine(inputs.numbers, rest)
        problem, still = problem_of(end, inputs), base_net_of(end, inputs)
        feet = resting.feet
        if not method.finds_feet:
            feet = feet_at(surface, feet.rows, *given_feet_of(end, inputs))
        found = stationarity_residual(method, end.state, surface, problem, feet, resting.free, still)
        return found.value, _outward(end, inputs, resting, still, found)

    return residual


def _outward(
    end: EndOfFit, inputs: FitInputs, resting: _RestingFit, still: Array, found: StationarityResidual
) -> Fitted:
    """In the user's unit and the order of the points."""
    unit, count = end.unit, inputs.points.shape[0]
    order = _PointOrder.of(end, resting.feet.rows, count)
    moved, kept = (x * unit.scale + unit.centre[None, None] for x in (resting.net, still))
    if inputs.control_points.shape == kept.shape:
        kept = inputs.control_points.astype(kept.dtype)  # to the last bit
    net = jnp.where(resting.free[:, :, None], moved, kept)
    u, v, error = (order.by_point(x, count) for x in (found.u, found.v, found.error))
    diagonal = problem_of(end, inputs).diagonal * unit.scale
    return Fitted(net, u, v, error * unit.scale, diagonal, resting.stationarity)
