"""Feet of a whole cloud, searched globally, by the very computation that the fit's loop runs.

The loop measures before it moves. Stopped there it is a projector, so the search for the nearest feet,
before and after a fit, needs no compilation of its own.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfit._approximation._knot_insertion import Growth, cut
from jaxfit._closest import globally, padded, prepare
from jaxfit._fit._loop import AbstractIterativeMethod, Limits, advance, begin
from jaxfit._fit._problem import Problem
from jaxfit._splines._pieces import make_axis

Feet = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def global_feet(
    method: AbstractIterativeMethod,
    problem: Problem,
    net: Array,
    growth: Growth | None,
    count: int,
    max_steps: int,
    known: Feet | None = None,
) -> Feet:
    """(u, v, distance, found) of the first `count` points, in the problem's unit; perhaps nearer than the
    `known` ones.
    """
    if growth is None:
        prepared = prepare(net, problem.axis_u, problem.axis_v, sampled=True)
    else:  # nothing is to be sampled behind the last control point in use
        used, knots_u, knots_v = cut(net, growth)
        orders = (len(knots_u) - used.shape[0], len(knots_v) - used.shape[1])
        prepared = prepare(used, make_axis(knots_u, orders[0]), make_axis(knots_v, orders[1]), sampled=True)
    size = problem.target.shape[1]
    points = np.asarray(problem.target)[:, :count]
    dtype = problem.target.dtype
    nothing = jnp.asarray(0, jnp.int32)
    limits = Limits(jnp.asarray(-1.0, dtype), jnp.asarray(-1.0, dtype), nothing)

    def feet_from(which: Any, u: Any, v: Any) -> dict[str, np.ndarray]:
        chosen = points if which is None else points[:, which]
        real = jnp.asarray((np.arange(size) < chosen.shape[1]).astype(dtype))
        inputs = (jnp.asarray(padded(np.asarray(x), size).astype(dtype)) for x in (chosen, u, v))
        target, start_u, start_v = inputs
        mine = eqx.tree_at(lambda p: (p.target, p.weight, p.padding), problem, (target, real, real))
        first = begin(method, net, start_u, start_v, max_steps, mine, growth)
        carry = advance(method, mine, limits, nothing, first)
        m = carry.measured
        fields = dict(u=m.u, v=m.v, error=m.error, converged=m.found, steps=m.steps)
        feet = {name: np.asarray(x)[: chosen.shape[1]] for name, x in fields.items()}
        feet["f"] = feet.pop("error") ** 2
        return feet

    centred = points.T.astype(np.float64) - prepared.centre[None, :]
    feet = None
    if known is not None and known[3].all():
        parts = dict(zip(("u", "v", "error", "converged"), known, strict=True))
        feet = parts | dict(f=parts.pop("error") ** 2, steps=np.zeros(count, np.int32))
    best = globally(feet_from, prepared.samples, centred, size, feet)
    return best["u"], best["v"], np.sqrt(best["f"]), best["converged"]
