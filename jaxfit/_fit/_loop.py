"""The loop of every iterative fit: measure, accept, record, decide, move.

It ends on a surface that has been measured exactly. It calls methods through the contract
`AbstractIterativeMethod` only.
"""

import contextlib
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Int

from jaxfit._checks import is_concrete
from jaxfit._compile import compiled
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._method import AbstractIterativeMethod, Iterate
from jaxfit._fit._method_fields import static_and_numbers
from jaxfit._fit._problem import Problem, summary_of
from jaxfit._fit._reasons import RESULTS, code_of
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._unrolling import unrolled
from jaxfit._varying import as_varying, as_varying_as

FIRST_CHUNK = 4  # iterations between two reports of progress, to begin with
REPORT_SECONDS = 0.3
BLOCK = 16  # iterations of an unrolled fit that are kept at a time
# An average error beyond the diagonal plus so many times the first one counts as divergence: a surface that
# meets the points from the start may well be smoothed.
MAX_AVERAGE, MAX_GROWTH = 1.0, 1e3

Progress = Callable[[int, int, float, float], None]


class LoopState(eqx.Module):
    """The state of the loop: `current` has been measured, `next` has not."""

    current: Iterate
    next: Iterate
    history: ErrorHistory
    code: Int[Any, ""]
    exact: Bool[Any, ""]  # whether `next` is to be measured exactly


def begin(
    method: AbstractIterativeMethod, problem: Problem, surface: WorkingSurface, u: Any, v: Any, max_steps: int
) -> LoopState:
    """The state before the first measurement; the history has room for `max_steps` moves."""
    xp: Any = np if is_concrete(surface, u, v) else jnp  # NumPy's arrays cost no calls of their own
    none = xp.zeros_like(u, np.int32)
    nothing = xp.zeros((), np.int32)
    feet = FootPoints(u, v, xp.zeros_like(u), none, none > 0, nothing, nothing > 0, np.zeros(4, u.dtype))
    surface, state = method.init(problem, surface, feet)
    iterate = Iterate(surface, feet, state, nothing)
    history = ErrorHistory.empty(max_steps, problem.target.dtype)
    return LoopState(iterate, iterate, history, nothing + code_of(RESULTS.running), nothing == 0)


def run(
    method: AbstractIterativeMethod, problem: Problem, loop: LoopState, progress: Progress | None
) -> tuple[LoopState, dict[str, Any]]:
    """The whole loop at once, or with `progress` in chunks of about REPORT_SECONDS."""
    rest, numbers = static_and_numbers(method)
    inputs = (numbers, problem, loop)
    if not is_concrete(inputs):
        numbers, problem, loop = jax.tree.map(jnp.asarray, inputs)
    most = problem.tolerances.max_steps
    if progress is None:
        return _advance(rest, numbers, problem, most, loop)
    import time

    chunk = FIRST_CHUNK
    while True:
        begun = time.perf_counter()
        until = np.int32(min(int(loop.next.step) + chunk, int(most)))
        loop, stats = _advance(rest, numbers, problem, until, loop)
        seconds = time.perf_counter() - begun
        step = int(loop.current.step)
        errors = np.asarray(loop.history.errors)[:, step % loop.history.capacity]
        progress(step, int(most), float(errors[0]), float(errors[1]))
        if int(loop.code) != code_of(RESULTS.running):
            return loop, stats
        chunk = max(1, min(2 * chunk, int(chunk * REPORT_SECONDS / max(seconds, 1e-6))))


def compile_ahead(
    method: AbstractIterativeMethod,
    problem: Problem,
    surface: WorkingSurface,
    max_steps: int,
    differentiated: bool = False,
) -> None:
    """Begin to compile what `run` calls, all concrete. Where the points start does not matter. A fit that is
    to be `differentiated` by a method without a derivative will be refused.
    """
    somewhere = np.zeros(problem.weight.shape, problem.target.dtype)
    with contextlib.suppress(
        Exception
    ):  # what a method of the user's can't do from there, it will say in `run`
        loop = begin(method, problem, surface, somewhere, somewhere, max_steps)
        if differentiated:
            check_derivative(method, problem, loop.current)
        _advance.ahead(*static_and_numbers(method), problem, problem.tolerances.max_steps, loop)


def check_derivative(method: AbstractIterativeMethod, problem: Problem, here: Any) -> None:
    """Have a method that has no implicit derivative say so; `here` is an iterate, or the end of a fit."""
    jax.eval_shape(method.stationarity, problem, here.surface, here.state, here.projection.error)


@partial(compiled, kept=True, static_argnums=0)
def _advance(
    rest: Any, numbers: Any, problem: Problem, until: Array, loop: LoopState
) -> tuple[LoopState, dict[str, Any]]:
    """`iterate`, compiled.

    On a CPU a batch is fitted one after the other (`sequential_vmap`). An ordinary `vmap` would take every
    branch, and would gain nothing from doing the same steps at once.
    """
    whole = partial(iterate, rest)
    if jax.default_backend() == "cpu":
        whole = jax.custom_batching.sequential_vmap(whole)
    return whole(numbers, problem, until, loop)


def iterate(
    rest: Any, numbers: Any, problem: Problem, until: Array, loop: LoopState, most: int | None = None
) -> tuple[LoopState, dict[str, Any]]:
    """Iterate up to step `until`, or to the end, and postprocess; `rest` are the method's static fields.

    With `most`, the largest number of measurements, it has a derivative where it is traced `unrolling`.
    """
    method = eqx.combine(numbers, rest)
    running = code_of(RESULTS.running)

    def unfinished(loop: LoopState) -> Array:
        return (loop.code == running) & (loop.next.step <= until)

    if problem.axis is None:  # each device its own fit: all of it differs from device to device
        loop = as_varying(loop, numbers, problem, loop)
    step = partial(_one_iteration, method, problem)
    if most is None:
        loop = lax.while_loop(unfinished, step, loop)
    else:
        loop = _as_often(most, unfinished, step, loop)
    early = (loop.code == code_of(RESULTS.stalled)) | (loop.code == code_of(RESULTS.diverged))
    last, stats = method.postprocess(problem, loop.current, early)
    if last is not loop.current:  # what goes on is not what it would end with
        last = lax.cond(loop.code == running, lambda: loop.current, lambda: last)
    return eqx.tree_at(lambda x: x.current, loop, last), stats


def _as_often(
    most: int,
    unfinished: Callable[[LoopState], Array],
    step: Callable[[LoopState], LoopState],
    loop: LoopState,
) -> LoopState:
    """`step` as long as the fit is `unfinished`, at most `most` times, in a loop that has a derivative.

    Reverse mode keeps the states that blocks of iterations begin with, and those within one block.
    """

    @jax.checkpoint
    def one(loop: LoopState, _: None) -> tuple[LoopState, None]:
        return lax.cond(unfinished(loop), step, lambda loop: loop, loop), None

    @jax.checkpoint
    def block(loop: LoopState, _: None) -> tuple[LoopState, None]:
        return lax.scan(one, loop, None, min(most, BLOCK))

    return lax.scan(block, loop, None, -(-most // BLOCK))[0]


def _one_iteration(method: AbstractIterativeMethod, problem: Problem, loop: LoopState) -> LoopState:
    """Measure, accept, record, decide, move."""
    old, new = loop.current, loop.next
    exact = jnp.asarray(True) if unrolled() else loop.exact
    projection, state = method.measure(problem, new, exact)
    projection, state = _over_all_points(problem, projection, old.projection, state)
    new = as_varying_as(Iterate(new.surface, projection, state, new.step), new)
    new = lax.cond(new.step > 0, lambda: method.accept(problem, old, new), lambda: new)
    return record_and_move(method, problem, loop, new)


def _over_all_points(
    problem: Problem, projection: FootPoints, before: FootPoints, state: Any
) -> tuple[FootPoints, Any]:
    """The projection with its summary, and the state whose `sums`, if it has any, are those over all points:
    one reduction over the devices.
    """
    totals, maximum = problem.totals(projection, before)
    sums = getattr(state, "sums", None)
    parts = (totals, problem.by_device(maximum), projection.active, sums)
    totals, maxima, active, sums = problem.total(parts)
    summary = summary_of(totals, jnp.max(maxima))
    projection = dataclasses.replace(projection, active=active, summary=summary)
    return projection, state if sums is None else eqx.tree_at(lambda s: s.sums, state, sums)


def record_and_move(
    method: AbstractIterativeMethod, problem: Problem, loop: LoopState, new: Iterate
) -> LoopState:
    """Record the errors of an iterate that has been measured and accepted, decide, and move."""
    running, diverged = code_of(RESULTS.running), code_of(RESULTS.diverged)
    counts = jnp.concatenate([new.projection.active[None], jnp.asarray(new.surface.used)])
    history = loop.history.append(new.step, new.projection.summary, counts)
    code = _decide(method, problem, new, history)
    again = (code != running) & (code != diverged) & ~new.projection.exact
    code = jnp.where(again, running, code)
    following, history = lax.cond(
        (code == running) & ~again,
        lambda: method.move(problem, new, history),
        lambda: (new, history),
    )
    good = as_varying_as(LoopState(new, following, history, code, again), loop)
    # A surface that is not finite, or far worse than the first, is discarded.
    kept = eqx.tree_at(lambda x: x.code, loop, good.code)
    return lax.cond((code == diverged) & (new.step > 0), lambda: kept, lambda: good)


def _decide(
    method: AbstractIterativeMethod, problem: Problem, iterate: Iterate, history: ErrorHistory
) -> Int[Array, ""]:
    """Whether the loop ends on a surface that has just been measured, as the code of one of RESULTS."""
    step, goal = iterate.step, problem.tolerances
    average, maximum = history.at(step)[0], history.at(step)[1]
    finite = jnp.isfinite(maximum) & jnp.all(jnp.isfinite(iterate.surface.control_points))
    sound = finite & (average <= MAX_AVERAGE + MAX_GROWTH * history.first)
    met = (average <= goal.average) & (maximum <= goal.maximum)
    stalled = history.is_stalled(step, method.stall_after, method.stall_gain, method.stall_since)
    outcomes = (
        (~sound, RESULTS.diverged),
        (met, RESULTS.converged),
        (stalled, RESULTS.stalled),
        (step >= goal.max_steps, RESULTS.max_steps_reached),
    )
    code: Any = code_of(RESULTS.running)
    for holds, result in reversed(outcomes):
        code = jnp.where(holds, jnp.asarray(code_of(result), jnp.int32), code)
    return code
