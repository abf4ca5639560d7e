"""Methods whose moves need sums over the points only: their `state.sums`, added up over blocks or devices."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._approximation._automatic_smoothing import AbstractSmoothing
from jaxfit._approximation._geometric import GeometricApproximation
from jaxfit._approximation._linear_least_squares import GaussNewton
from jaxfit._approximation._orthogonal import OrthogonalDistance
from jaxfit._approximation._smoothing_term import plate_of
from jaxfit._approximation._standard import StandardApproximation, StandardState
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._method import AbstractIterativeMethod, Iterate
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import NormalOperator, Stencil, free_points, normal_solver


class NormalSums(eqx.Module):
    """A^T W A, and A^T W (A P - Q) for the present net P."""

    stencil: Stencil
    gradient: Float[Any, "nu nv d"]


class StateWithSums(StandardState):
    """The state of `StandardApproximation`, and the sums that its next move needs."""

    sums: NormalSums


class StandardBySums(StandardApproximation):
    """`StandardApproximation` whose points are summed up where they are measured."""

    def init(
        self, problem: Problem, surface: WorkingSurface, projection: FootPoints
    ) -> tuple[WorkingSurface, StateWithSums]:
        """The state with zeros for sums."""
        surface, state = super().init(problem, surface, projection)
        net = surface.control_points
        entries = np.zeros((*surface.order, *net.shape[:2]), net.dtype)
        sums = NormalSums(Stencil(entries), np.zeros(net.shape, net.dtype))
        return surface, StateWithSums(state.smoothing, state.shift, state.plate, sums)

    def measure(self, problem: Problem, iterate: Iterate, exact: Array) -> tuple[FootPoints, StateWithSums]:
        """Feet, and the sums at them."""
        projection, state = super().measure(problem, iterate, exact)
        surface = iterate.surface
        system = self.system(problem, surface, projection, state.smoothing, state.plate)
        gradient = system.data_adjoint(system.data_residual(surface.control_points))
        sums = NormalSums(system.data_stencil(), gradient)
        return projection, StateWithSums(state.smoothing, state.shift, state.plate, sums)

    def move(self, problem: Problem, iterate: Iterate, history: ErrorHistory) -> tuple[Iterate, ErrorHistory]:
        """The least-squares net, by a correction of the present one."""
        surface, state = iterate.surface, iterate.state
        net, plate, sums = surface.control_points, plate_of(state.plate, surface), state.sums
        stencil = sums.stencil.plus(plate.stencil().times(state.smoothing))
        free = free_points(stencil, self.held(surface))
        gradient = sums.gradient + state.smoothing * plate.adjoint(plate.residual(net))
        operator = NormalOperator(stencil, free, net.shape[2])
        solver: Any = normal_solver(operator)
        factors = solver.init(operator, {})
        step, _, _ = solver.compute(factors, jnp.where(free[:, :, None], gradient, 0.0), {})
        moved = surface.moved_to(jnp.where(free[:, :, None], net - step, net))
        shift = jnp.maximum(state.shift, getattr(factors, "shift", jnp.zeros((), net.dtype)))
        state = StateWithSums(state.smoothing, shift, state.plate, sums)
        return Iterate(moved, iterate.projection, state, iterate.step + 1), history


class GeometricBySums(GeometricApproximation):
    """`GeometricApproximation` without a state of single points.

    Converged feet start where they were, not ahead: their last move would have to be stored.
    """

    @property
    def _extrapolates(self) -> bool:
        return False


IN_BLOCKS: dict[type, type] = {
    StandardApproximation: StandardBySums,
    GeometricApproximation: GeometricBySums,
}
ON_DEVICES: dict[type, type] = {**IN_BLOCKS, OrthogonalDistance: OrthogonalDistance}


def by_sums(method: AbstractIterativeMethod, kinds: dict[type, type], where: str) -> AbstractIterativeMethod:
    """The method, kept to sums over the points, by one of `kinds`; raises if it needs more.

    `where` says in an error what the points are like.
    """
    kind = kinds.get(type(method))
    if kind is None:
        *others, last = (f"{x.__name__}()" for x in kinds)
        raise TypeError(
            f"method must be {', '.join(others)} or {last}, whose moves follow from sums over the points, "
            f"{where}, but is {type(method).__name__}(); pass one of these, or fit the points together by "
            "approximate(points, base, method)."
        )
    fields = {x.name: getattr(method, x.name) for x in dataclasses.fields(method)}
    _check_fields(fields, where)
    return kind(**fields)


def _check_fields(fields: dict[str, Any], where: str) -> None:
    """Raise for an option that looks at all points together."""
    loss = fields["loss"]
    refused = {
        "insertion": ("None", fields["insertion"] is not None),
        "local": ("False", fields.get("local", False)),
        "smoothing": ("lambda, a number", isinstance(fields.get("smoothing"), AbstractSmoothing)),
        "solver": ("GaussNewton()", not isinstance(fields.get("solver", GaussNewton()), GaussNewton)),
        "loss": (f"{type(loss).__name__}(scale)", loss is not None and loss.scale is None),
    }
    for name, (instead, wrong) in refused.items():
        if wrong:
            raise ValueError(
                f"the method's {name} must be {instead} {where}, but is {fields[name]!r}, which looks at all "
                f"points together; pass {instead}, or fit the points together by approximate."
            )
