"""`fit_stream`: one fit of a cloud that is read in blocks, from checked arguments to its result."""

import os
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxfit._approximation._checked_arguments import check_options, checked_start, checked_weights
from jaxfit._approximation._cloud_fit import (
    LEAST_POINTS,
    final_code,
    fitted_surface,
    stats_of,
    tolerances_of,
    working_surface,
)
from jaxfit._approximation._errors import GlobalFeet
from jaxfit._approximation._methods_by_sums import IN_BLOCKS, by_sums
from jaxfit._checks import as_floating, check_kind, check_number, is_concrete
from jaxfit._compile import compiled
from jaxfit._fit._history import public_history
from jaxfit._fit._loop import LoopState, begin, record_and_move
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._method_fields import static_and_numbers
from jaxfit._fit._problem import Problem, make_problem, summary_of
from jaxfit._fit._reasons import RESULTS, code_of, result_of
from jaxfit._fit._result import Fit, converged_or_raise
from jaxfit._fit._scaling import Unit, unit_of
from jaxfit._precision import advise_x64, working_dtype
from jaxfit._progress_line import doing
from jaxfit._splines import BSplineSurface
from jaxfit._streams._blocks import Blocks, Source
from jaxfit._streams._passes import Measured, Passes
from jaxfit._streams._stored_feet import StoredFeet


def fit_stream(
    source: Source,
    base: BSplineSurface,
    method: AbstractIterativeMethod,
    block_size: int,
    feet_file: str | os.PathLike[str] | None,
    request: dict[str, Any],
) -> Fit:
    """`approximate_stream`, the options that it shares with `approximate` in a dictionary."""
    streamed = _checked_method(base, method, block_size, request)
    passes = _opened(source, base, streamed, block_size, feet_file, request)
    try:
        return _fitted(passes, base, method, streamed, request)
    except BaseException:
        passes.feet.discard()
        raise


def _fitted(
    passes: Passes,
    base: BSplineSurface,
    method: AbstractIterativeMethod,
    streamed: AbstractIterativeMethod,
    request: dict[str, Any],
) -> Fit:
    unit = passes.unit
    begun = working_surface(base, unit, True)
    nothing = make_problem(np.zeros((0, base.dimension)), None, unit, passes.tolerances, padded=False)
    none = np.zeros(0, working_dtype())
    loop = begin(streamed, nothing, begun, none, none, request["max_steps"])
    searched = base if request["start"] is None else None
    loop = _run(passes, nothing, loop, searched, request["progress"])
    stats = _postprocess(*static_and_numbers(streamed), nothing, loop)
    surface = fitted_surface(loop.current.surface, base, begun, unit)
    lost = int(loop.code) == code_of(RESULTS.diverged)  # the stored feet are those of a surface given up
    errors = GlobalFeet() if request["errors"] is None else request["errors"]
    average, maximum, unconverged = passes.finish(loop.current, surface, errors, lost)
    loss = unit.loss(np.asarray(surface.control_points))
    code = final_code(loop.code, (average, maximum), loss, passes.tolerances)
    known = stats_of(method, passes.tolerances, loop.current.step, unit, unconverged)
    mean, largest = jax.device_put([np.asarray(x, working_dtype()) for x in (average, maximum)])
    u, v, relative = passes.feet.rows
    fit = Fit(
        surface=surface,
        u=u,
        v=v,
        errors=relative,
        average_error=mean,
        maximum_error=largest,
        history=public_history(loop.history, loop.current.step, getattr(method, "fairing", None)),
        result=result_of(code),
        stats=known | {"passes": passes.made + 1} | stats,  # with the first, which finds the unit
    )
    return converged_or_raise(fit) if request["throw"] else fit


def _checked_method(
    base: BSplineSurface, method: AbstractIterativeMethod, block_size: int, request: dict[str, Any]
) -> AbstractIterativeMethod:
    """The method by sums; raises if an argument is not valid, before anything is read."""
    goals = request["tol_average"], request["tol_maximum"]
    options = (request[x] for x in ("max_steps", "progress", "throw", "errors"))
    check_kind("base", base, BSplineSurface, "base_surface(boundary)")
    check_options(method, *goals, *options)
    _check_concrete(base, method, request)
    check_number("block_size", block_size, 1, whole=True)
    for tolerance in goals:
        if tolerance is not None:
            advise_x64(float(np.asarray(tolerance)), np.dtype(base.control_points.dtype))
    return by_sums(method, IN_BLOCKS, "where points are read in blocks")


def _opened(
    source: Source,
    base: BSplineSurface,
    method: AbstractIterativeMethod,
    block_size: int,
    feet_file: str | os.PathLike[str] | None,
    request: dict[str, Any],
) -> Passes:
    """The points, seen once, with their weights and first feet."""
    weights, start = request["weights"], request["start"]
    blocks = Blocks(source, base.dimension, block_size)
    weights = None if weights is None else np.asarray(as_floating("weights", weights, 1))
    _check_file(feet_file, (blocks.source, request["weights"], *(start if isinstance(start, tuple) else ())))
    count, unit = _count_and_unit(blocks, weights)
    weights = checked_weights(weights, count)
    feet = None if start is None else checked_start(start, count, base.domain)
    stored = StoredFeet(count, base.domain, feet_file)
    for k in () if feet is None else range(0, count, block_size):
        stored.write(k, *(x[k : k + block_size] for x in feet or ()))
    tolerances = tolerances_of(request["tol_average"], request["tol_maximum"], request["max_steps"])
    return Passes(blocks, weights, unit, tolerances, stored, method)


def _check_concrete(base: BSplineSurface, method: Any, request: dict[str, Any]) -> None:
    if not is_concrete(base, method, request):
        raise TypeError(
            "approximate_stream must be called outside transformations, since it reads its points on the "
            "host, but an argument is traced; fit in memory by approximate there."
        )


def _check_file(path: str | os.PathLike[str] | None, inputs: tuple[Any, ...]) -> None:
    """Raise if the file to be written is one that is read."""
    for x in inputs:
        file = getattr(x, "filename", None)
        if path is not None and file is not None and os.path.realpath(path) == os.path.realpath(file):
            raise ValueError(
                f"feet_file must be a file of its own, but {os.fspath(path)} is read as well; name another."
            )


def _count_and_unit(blocks: Blocks, weights: Any) -> tuple[int, Unit]:
    """The number of points, and the unit of those of positive weight: a first pass."""
    corners, count = [], 0
    for start, points in blocks:
        count = start + len(points)
        if weights is not None:
            weight = np.asarray(weights[start:count])
            points = points[weight > 0] if weight.shape == points.shape[:1] else points
        if len(points):
            columns = np.ascontiguousarray(points.T)
            corners += [columns.min(axis=1), columns.max(axis=1)]
    if count < LEAST_POINTS:
        raise ValueError(
            f"source must hold at least {LEAST_POINTS} points, but holds {count}; look whether it is read "
            "from its beginning."
        )
    if not corners:
        checked_weights(weights, count)
    return count, unit_of(np.stack(corners), "source")


def _run(
    passes: Passes, problem: Problem, loop: LoopState, searched: BSplineSurface | None, progress: Any
) -> LoopState:
    """The loop of `_fit/_loop.py` on the host: a pass, then what follows from its sums."""
    while int(loop.code) == code_of(RESULTS.running):
        doing(f"pass {int(loop.next.step) + 1} over {passes.blocks.count:,} points")
        measured = passes.measure(loop.next, loop.exact, searched)
        searched = None
        loop = _advance(*static_and_numbers(passes.method), problem, loop, measured)
        if progress is not None:
            step = int(loop.current.step)
            average, maximum = np.asarray(loop.history.errors)[:2, step % loop.history.capacity]
            progress(step, int(problem.tolerances.max_steps), float(average), float(maximum))
    return loop


@partial(compiled, kept=True, static_argnums=0)
def _advance(rest: Any, numbers: Any, problem: Problem, loop: LoopState, measured: Measured) -> LoopState:
    """Record the errors, decide, and move. The problem holds no points."""
    new = loop.next
    state = eqx.tree_at(lambda x: x.sums, new.state, measured.sums)
    summary = summary_of(measured.totals, measured.maximum)
    parts = (measured.active, measured.exact, summary)
    projection = eqx.tree_at(lambda x: (x.active, x.exact, x.summary), new.projection, parts)
    new = eqx.tree_at(lambda x: (x.projection, x.state), new, (projection, state))
    return record_and_move(eqx.combine(numbers, rest), problem, loop, new)


@partial(compiled, kept=True, static_argnums=0)
def _postprocess(rest: Any, numbers: Any, problem: Problem, loop: LoopState) -> dict[str, Any]:
    """The method's statistics; the methods that go by sums return the last iterate as it is."""
    early = (loop.code == code_of(RESULTS.stalled)) | (loop.code == code_of(RESULTS.diverged))
    return eqx.combine(numbers, rest).postprocess(problem, loop.current, early)[1]
