"""The end of a geometric interpolation that has stalled: the linear system at the parameters of the grid.

It has a solution for any grid with distinct rows and columns, but decisions about it need values: inside
transformations a stalled fit stays as it is.
"""

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from jax import Array

from jaxfit._compile import compiled
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._loop import LoopState
from jaxfit._fit._reasons import RESULTS, code_of
from jaxfit._interpolation._gmres import append_errors, distances
from jaxfit._interpolation._method import Frame, Pair, Solution, errors_only
from jaxfit._interpolation._tensor_collocation import tensor_collocation
from jaxfit._splines import Reflection

# Errors that fall by less than this share in 40 iterations need more than 600 for nine orders of magnitude.
LEAST_GAIN = 0.75
ROUNDING = 16  # rounding units of the diagonal: the linear system would leave errors of this size, too


def with_larger_stall_gain(method: Any) -> Any:
    """`method`, but a slow fit counts as stalled sooner, since the linear system can take over."""
    return dataclasses.replace(method, stall_gain=max(method.stall_gain, LEAST_GAIN))


def has_stalled(loop: LoopState, maximum: Any, max_steps: Any) -> bool:
    """Whether a fit has stopped short with errors above rounding, and may make one more step."""
    short = int(loop.code) in (code_of(RESULTS.stalled), code_of(RESULTS.diverged))
    noise = ROUNDING * float(np.finfo(loop.history.errors.dtype).eps)
    return short and not float(maximum) <= noise and int(loop.current.step) < int(max_steps)


def solved_at_grid(
    order: tuple[int, int],
    data: Any,
    averaged: Pair,
    symmetry: Reflection | None,
    frame: Frame,
    history: ErrorHistory,
    found: Solution,
) -> Solution:
    """The interpolant at the averaged parameters as one more step, or what was `found` if that is closer."""
    net, errors, history = _solve(
        order, found.knots, averaged, data, frame.diagonal, history, found.steps + 1
    )
    maximum = float(np.max(errors))
    if not maximum < float(np.max(found.errors)):  # nor if it is NaN
        return found
    if symmetry is not None:
        net = symmetry.symmetrise_points(net)
    result = RESULTS.converged if maximum <= float(frame.goal) else RESULTS.stalled
    u, v = (np.broadcast_to(x, data.shape[:2]) for x in (averaged[0][:, None], averaged[1][None, :]))
    steps = found.steps + 1
    return dataclasses.replace(
        found,
        net=np.asarray(net),
        u=u,
        v=v,
        errors=np.asarray(errors),
        history=errors_only(history, steps),
        code=np.int32(code_of(result)),
        steps=steps,
        unconverged_feet=np.int32(0),
        stats={**found.stats, "solved": np.bool_(True)},
    )


@partial(compiled, kept=True, static_argnums=0)
def _solve(
    order: tuple[int, int],
    knots: Pair,
    averaged: Pair,
    data: Array,
    diagonal: Array,
    history: ErrorHistory,
    step: Array,
) -> tuple[Array, Array, ErrorHistory]:
    """The net, its errors as fractions of the diagonal, and the history with these."""
    tensor = tensor_collocation(knots, order, *averaged)
    net = tensor.solve(data)
    errors = distances(data - tensor.times(net), diagonal)
    return net, errors, append_errors(history, step, errors)
