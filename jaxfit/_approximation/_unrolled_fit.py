"""A fit with the derivative of its iterations as they were run."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxfit._approximation._automatic_smoothing import AbstractSmoothing
from jaxfit._approximation._fit_inputs import EndOfFit, FitInputs, base_net_of, given_feet_of, problem_of
from jaxfit._compile import compiled
from jaxfit._differentiable_once import differentiable_once
from jaxfit._fit._loop import LoopState, begin, iterate
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._method_fields import dynamic_fields
from jaxfit._fit._scaling import Unit
from jaxfit._splines import BSplineSurface
from jaxfit._unrolling import unrolling


def unrolled_fit(
    first: EndOfFit,
    max_steps: int,
    cloud: Any,
    base: BSplineSurface,
    method: AbstractIterativeMethod,
    request: dict[str, Any],
) -> tuple[LoopState, dict[str, Any], Unit]:
    """The loop, the method's `stats` and the unit, from before the `first` iteration, as functions of the
    arguments of `approximate`.
    """
    if isinstance(getattr(method, "smoothing", None), AbstractSmoothing):
        chosen: Any = {"smoothing": jnp.asarray(first.state.smoothing)}
        method = dataclasses.replace(method, **chosen)
    _, rest = dynamic_fields(method)
    inputs = FitInputs.of(cloud, base, method, request)
    inputs = differentiable_once(inputs) if method.finds_feet else inputs
    loop, stats, diagonal = _unrolled(rest, max_steps, first, inputs)
    return loop, stats, dataclasses.replace(first.unit, diagonal=diagonal)


@partial(compiled, static_argnums=(0, 1))
def _unrolled(
    rest: Any, max_steps: int, first: EndOfFit, inputs: FitInputs
) -> tuple[LoopState, dict[str, Any], Array]:
    first = lax.stop_gradient(jax.tree.map(jnp.asarray, first))
    with unrolling():
        method = eqx.combine(inputs.numbers, rest)
        problem = problem_of(first, inputs)
        problem = eqx.tree_at(lambda p: p.tolerances.max_steps, problem, np.int32(max_steps))
        surface = first.surface.moved_to(base_net_of(first, inputs))
        loop = begin(method, problem, surface, *given_feet_of(first, inputs), max_steps)
        loop = jax.tree.map(jnp.asarray, loop)
        until = jnp.asarray(max_steps, jnp.int32)
        loop, stats = iterate(rest, inputs.numbers, problem, until, loop, max_steps + 1)
    return loop, stats, problem.diagonal * first.unit.scale
