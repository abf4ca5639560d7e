"""Feet of a whole cloud, searched globally, by the very computation that the fit's loop runs.

The loop measures before it moves. Stopped there it is a projector, so the search for the nearest feet,
before and after a fit, needs no compilation of its own.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfit._closest import globally, prepare
from jaxfit._fit._loop import AbstractIterativeMethod, Limits, advance, begin
from jaxfit._fit._problem import Problem

Feet = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def global_feet(
    method: AbstractIterativeMethod, problem: Problem, net: Array, count: int, max_steps: int
) -> Feet:
    """(u, v, distance, found) of the first `count` points, in the problem's unit."""
    prepared = prepare(net, problem.knots_u, problem.knots_v, sampled=True)
    points = np.asarray(problem.target).T
    size = points.shape[0]
    dtype = problem.target.dtype
    nothing = jnp.asarray(0, jnp.int32)
    limits = Limits(jnp.asarray(-1.0, dtype), jnp.asarray(-1.0, dtype), nothing)

    def feet_from(which: Any, u: Any, v: Any) -> dict[str, np.ndarray]:
        chosen = points[:count][which]
        filling = size - len(chosen)

        def padded(x: Any) -> np.ndarray:
            return np.concatenate([x, np.repeat(x[-1:], filling, axis=0)])

        real = jnp.asarray((np.arange(size) < len(chosen)).astype(dtype))
        target = jnp.asarray(np.ascontiguousarray(padded(chosen).T))
        mine = eqx.tree_at(lambda p: (p.target, p.weight, p.padding), problem, (target, real, real))
        start_u, start_v = (jnp.asarray(padded(np.asarray(x)).astype(dtype)) for x in (u, v))
        first = begin(net, start_u, start_v, max_steps)
        carry = advance(method, mine, limits, nothing, first)
        m = carry.measured
        fields = dict(u=m.u, v=m.v, f=m.error**2, ok=m.found, n=m.steps)
        return {name: np.array(x)[: len(chosen)] for name, x in fields.items()}

    centred = points[:count].astype(np.float64) - np.asarray(prepared.centre, np.float64)
    best = globally(feet_from, prepared.samples, centred, size)
    return best["u"], best["v"], np.sqrt(best["f"]), best["ok"]
