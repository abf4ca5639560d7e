"""The end of a geometric interpolation that has stalled, or converged to a surface that folds: the linear
system at the parameters of the grid.

It has a solution for any grid with distinct rows and columns, but decisions about it need values: inside
transformations such a fit stays as it is. Feet are first searched while the surface is still far from the
data. Where rows lie much closer together than columns, they may slide so far that a surface with these feet
has to fold.
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
from jaxfit._quality import regularity
from jaxfit._splines import BSplineSurface, Reflection

# Errors that fall by less than this share in 40 iterations need more than 600 for nine orders of magnitude.
LEAST_GAIN = 0.75
ROUNDING = 16  # rounding units of the diagonal: the linear system would leave errors of this size, too


def with_larger_stall_gain(method: Any) -> Any:
    """`method`, but a slow fit counts as stalled sooner, since the linear system can take over."""
    return dataclasses.replace(method, stall_gain=max(method.stall_gain, LEAST_GAIN))


def finished_at_grid(
    order: tuple[int, int],
    data: Any,
    averaged: Pair,
    symmetry: Reflection | None,
    frame: Frame,
    loop: LoopState,
    found: Solution,
) -> Solution:
    """What was `found`, or the interpolant at the averaged parameters as one more step: where that comes
    closer than a fit that has stalled, or folds less than one that has converged.
    """
    stalled = _has_stalled(loop, found.errors.max())
    folds = 0 if stalled else _folds_of_slid_feet(data, found)
    if not (stalled or folds) or int(found.steps) >= int(frame.max_steps):
        return found
    solved = _solved(order, data, averaged, symmetry, frame, loop.history, found)
    maximum = float(solved.errors.max())
    if stalled:
        return solved if maximum < float(found.errors.max()) else found  # nor if it is NaN
    return solved if maximum <= float(frame.goal) and _folds(solved) < folds else found


def _has_stalled(loop: LoopState, maximum: Any) -> bool:
    """Whether a fit has stopped short with errors above rounding."""
    short = int(loop.code) in (code_of(RESULTS.stalled), code_of(RESULTS.diverged))
    noise = ROUNDING * float(np.finfo(loop.history.errors.dtype).eps)
    return short and not float(maximum) <= noise


def _folds_of_slid_feet(data: Any, found: Solution) -> int:
    """Folds of a fit that has converged. They are counted only if an edge of the net runs against that of
    its data points, for counting takes longer than many a fit.
    """
    if int(found.code) != code_of(RESULTS.converged):
        return 0
    along = (np.sum(np.diff(found.net, axis=k) * np.diff(data, axis=k), axis=2) for k in (0, 1))
    return _folds(found) if any((x < 0).any() for x in along) else 0


def _folds(found: Solution) -> int:
    return regularity(BSplineSurface(found.net, *found.knots)).folds


def _solved(
    order: tuple[int, int],
    data: Any,
    averaged: Pair,
    symmetry: Reflection | None,
    frame: Frame,
    history: ErrorHistory,
    found: Solution,
) -> Solution:
    """The interpolant at the averaged parameters."""
    steps = found.steps + 1
    net, errors, history = _solve(order, found.knots, averaged, data, frame.diagonal, history, steps)
    if symmetry is not None:
        net = symmetry.symmetrise_points(net)
    met = float(np.max(errors)) <= float(frame.goal)
    u, v = (np.broadcast_to(x, data.shape[:2]) for x in (averaged[0][:, None], averaged[1][None, :]))
    return dataclasses.replace(
        found,
        net=np.asarray(net),
        u=u,
        v=v,
        errors=np.asarray(errors),
        history=errors_only(history, steps),
        code=np.int32(code_of(RESULTS.converged if met else RESULTS.stalled)),
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
