"""G near a net whose feet are known: its value, its derivative, and the linear system with that."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._approximation._stationarity_residual import FeetInRows, feet_in_rows, stationarity_residual
from jaxfit._approximation._stationarity_system import StationaritySystem, stationarity_system
from jaxfit._cells import distances_at
from jaxfit._compile import compiled
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._problem import Problem
from jaxfit._fit._working_surface import WorkingSurface

Moved = tuple[Array, Array, Array]  # changes of u, v and the errors, (rows, width) each


class Linearisation(eqx.Module):
    """G at a net. `along_net` maps a change of the net to those of G, and of the `feet` and errors."""

    value: Float[Any, "nu nv d"]
    terms: Float[Any, ""]  # the norms of the terms of G
    rounding: Float[Any, ""]
    along_net: Callable[[Array], tuple[Array, Moved]]
    system: StationaritySystem
    feet: FeetInRows

    def change(self, move: Float[Array, "nu nv d"]) -> Float[Array, "nu nv d"]:
        """The derivative of G times a change of the net."""
        return self.along_net(move)[0]


@partial(compiled, static_argnums=0)
def linearisation(
    rest: Any,
    numbers: Any,
    problem: Problem,
    surface: WorkingSurface,
    state: Any,
    net: Float[Array, "nu nv d"],
    here: FootPoints,
    shift: Float[Array, ""],
    free: Bool[Array, "nu nv"],
    steps: Int[Array, ""],
) -> Linearisation:
    """At `net`, whose feet are `here`; control points that are not free stay where `surface` has them.

    `rest` and `numbers` are the method. What is free is found out before the first step and remains so.
    """
    problem, surface, state, here = jax.tree.map(jnp.asarray, (problem, surface, state, here))
    method, there = eqx.combine(numbers, rest), surface.moved_to(net)
    places, error = (here.u, here.v), here.error
    if not method.finds_feet:
        error = distances_at(there.pieces, *places, problem.target, problem.real)
    feet = feet_in_rows(there, problem, *places)
    system = stationarity_system(method, state, there, problem, feet.rows, places, error, shift)
    free = jnp.where(steps > 0, free, system.free)

    def residual(net: Array) -> tuple[tuple[Array, Moved], tuple[Array, Array]]:
        moved = surface.moved_to(net)
        found = stationarity_residual(method, state, moved, problem, feet, free, surface.control_points)
        return (found.value, (found.u, found.v, found.error)), (found.terms, found.rounding)

    (value, _), along, (terms, rounding) = jax.linearize(residual, net, has_aux=True)
    return Linearisation(value, terms, rounding, along, eqx.tree_at(lambda s: s.free, system, free), feet)
