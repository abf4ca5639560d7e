"""The loop of every iterative fit, written once.

A method gives `measure` (feet and errors on the present surface) and `move` (a better net from them). The
loop measures, records, decides, and moves; it ends on a surface that has been measured.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._checks import check_kind, check_number, is_concrete
from jaxfit._closest import AbstractFootMethod, Newton
from jaxfit._fit._reasons import RESULTS
from jaxfit._precision import bucket
from jaxfit._splines._pieces import Axis, Pieces, pieces_on

FIRST_CHUNK = 4  # iterations between two reports of progress, to begin with
REPORT_SECONDS = 0.3
LEAST_HISTORY = 1024  # entries, so that other limits on the iterations compile nothing
GROWTH = 1e3  # errors beyond this many times the first ones count as divergence


class Measured(eqx.Module):
    """Feet and errors of all points on a surface. Lengths in the unit of the problem."""

    u: Float[Any, " points"]
    v: Float[Any, " points"]
    error: Float[Any, " points"]
    steps: Int[Any, " points"]
    found: Bool[Any, " points"]
    active: Int[Any, ""] | None = None  # points of a cloud that play a part
    pulls: Any = None  # of methods that gather them while they measure
    poor: Bool[Any, " points"] | None = None  # of methods that mark points that are, or were, too far away
    ahead: Any = None  # of methods whose feet start from where their last move leads


class Limits(eqx.Module):
    """When to stop. Tolerances and errors are fractions of the diagonal."""

    average: Float[Any, ""]
    maximum: Float[Any, ""]
    max_steps: Int[Any, ""]


class Records(eqx.Module):
    """One entry for each iteration; NaN where there has been none."""

    average: Float[Any, " steps"]
    maximum: Float[Any, " steps"]
    evaluations: Float[Any, " steps"]  # of the surface for one foot, on average
    change: Float[Any, " steps"]  # of the feet's parameters since the iteration before, on average
    active: Int[Any, " steps"] | None = None  # points that pull
    shape: Int[Any, "2 steps"] | None = None  # of the net

    def at(self, step: Array, *values: Array | float) -> "Records":
        """With the values (average, maximum, evaluations, change) of one iteration."""
        columns = (self.average, self.maximum, self.evaluations, self.change)
        entered = (x.at[step].set(value) for x, value in zip(columns, values, strict=True))
        average, maximum, evaluations, change = entered
        return Records(average, maximum, evaluations, change, self.active, self.shape)

    def counting(self, step: Array, active: Array, axes: tuple[Axis, Axis]) -> "Records":
        """With the number of points that pull, and the size of the net."""
        if self.active is None or self.shape is None:
            return self
        used = jnp.stack([jnp.asarray(axis.used, jnp.int32) for axis in axes])
        return eqx.tree_at(
            lambda r: (r.active, r.shape),
            self,
            (self.active.at[step].set(active), self.shape.at[:, step].set(used)),
        )

    def has_risen(self, step: Array) -> Array:
        """Whether the average error is greater than in the iteration before."""
        return self.average[step] > self.average[jnp.maximum(step - 1, 0)]

    def is_stalled(self, step: Array, window: int, gain: float, since: int = 0) -> Array:
        """Whether neither error has fallen by the share `gain` within `window` iterations, those before
        `since` not counting.
        """
        before, keep = jnp.maximum(step - window, 0), 1.0 - gain
        slow = self.average[step] > keep * self.average[before]
        return slow & (self.maximum[step] > keep * self.maximum[before]) & (step >= window + since)


class Turn(eqx.Module):
    """A net, how many moves it took to get there, and what has been recorded on the way."""

    net: Float[Any, "nu nv d"]
    step: Int[Any, ""]
    records: Records
    growth: Any = None  # of a net that gets more knots on the way
    shift: Float[Any, ""] | None = None  # most that a singular system has been shifted, where any is solved
    trust: Any = None  # of methods that may take a step back
    momentum: Any = None  # of methods that are accelerated

    def axes(self, problem: Any) -> tuple[Axis, Axis]:
        """Both directions of the knots."""
        return (problem.axis_u, problem.axis_v) if self.growth is None else self.growth.axes


class Best(eqx.Module):
    """The net with the smallest maximum error so far."""

    net: Float[Any, "nu nv d"]
    measured: Measured
    maximum: Float[Any, ""]


class Carry(eqx.Module):
    """What goes round the loop: `net` has been measured, after `step` moves; `next` has not."""

    net: Float[Any, "nu nv d"]
    step: Int[Any, ""]
    next: Turn
    measured: Measured
    code: Int[Any, ""]
    best: Best | None  # for methods that may wander off
    exact: Bool[Any, ""]  # whether `next` is to be measured with feet converged
    growth: Any  # of `net`


class AbstractIterativeMethod(eqx.Module):
    """A method that improves a control net step by step. Its fields are known before tracing."""

    foot_tolerance: eqx.AbstractVar[float]
    stall_window: eqx.AbstractVar[int]
    stall_gain: eqx.AbstractVar[float]

    # What else goes round the loop.
    keeps_best: ClassVar[bool] = False  # the best net that has been measured
    counts: ClassVar[bool] = False  # how many points play a part, and the size of the net
    gathers: ClassVar[bool] = False  # pulls, while it measures
    solves: ClassVar[bool] = False  # systems that may be singular
    retreats: ClassVar[bool] = False  # from steps that make the objective worse

    def __check_init__(self) -> None:
        check_number("foot_tolerance", self.foot_tolerance, 0.0)
        check_kind("foot_method", getattr(self, "foot_method", Newton()), AbstractFootMethod, "Newton()")
        check_number("stall_window", self.stall_window, 1, whole=True)
        check_number("stall_gain", self.stall_gain, 0.0)

    @property
    def foresees(self) -> bool:
        """Whether feet between the first surface and the last need not have converged."""
        return False

    @property
    def comparable_since(self) -> int:
        """The first iteration whose errors later ones may be compared with."""
        return 0

    @property
    def glides(self) -> bool:
        """Whether there is momentum."""
        return False

    @property
    def leads(self) -> bool:
        """Whether feet start from where their last move leads them."""
        return False

    @property
    def marks(self) -> bool:
        """Whether points that are too far away are remembered."""
        return False

    def settle(self, problem: Any, turn: Turn, measured: Measured) -> tuple[Turn, Measured]:
        """What has been measured, or what was before if that was better."""
        del problem
        return turn, measured

    @abstractmethod
    def measure(
        self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, exact: Array
    ) -> Measured:
        """Feet on a surface, warm-started from the last ones, and the errors there."""

    @abstractmethod
    def move(self, problem: Any, limits: Limits, pieces: Pieces, measured: Measured, turn: Turn) -> Turn:
        """One or several moves from a net that has been measured, given its pieces."""


def begin(
    method: AbstractIterativeMethod,
    net: Any,
    u: Any,
    v: Any,
    most: int,
    problem: Any,
    growth: Any = None,
) -> Carry:
    """Before anything is measured; the history holds up to `most` + 1 entries.

    `growth` is that of a net with room for more.
    """
    from jaxfit._approximation._control_point_sums import WeightedErrors
    from jaxfit._approximation._damping import first_trust
    from jaxfit._approximation._extrapolation import Extrapolation
    from jaxfit._approximation._nesterov import at_rest

    xp: Any = np if is_concrete(net, u, v) else jnp  # NumPy's arrays cost no calls of their own
    none = xp.zeros(u.shape, np.int32)
    number = partial(xp.asarray, dtype=np.int32)
    empty = xp.full(bucket(most + 1, LEAST_HISTORY), np.nan, net.dtype)
    counts, sizes, nothing = None, None, None
    if method.counts:
        counts, sizes = xp.zeros(empty.shape, np.int32), xp.zeros((2, *empty.shape), np.int32)
        nothing = number(0)
    pulls = (
        WeightedErrors(xp.zeros((*net.shape[:2], net.shape[2] + 1), net.dtype)) if method.gathers else None
    )
    poor = none > 0 if method.marks else None
    shift = xp.zeros((), net.dtype) if method.solves else None
    ahead = None
    if method.leads:
        ahead = Extrapolation.none(u)
    measured = Measured(u, v, xp.zeros_like(u), none, none > 0, nothing, pulls, poor, ahead)
    trust = first_trust(net, u, v) if method.retreats else None
    momentum = at_rest(net) if method.glides else None
    records = Records(empty, empty, empty, empty, counts, sizes)
    turn = Turn(net, number(0), records, growth, shift, trust, momentum)
    best = Best(net, measured, xp.asarray(np.inf, net.dtype)) if method.keeps_best else None
    running = number(code_of(RESULTS.running))
    return Carry(net, number(-1), turn, measured, running, best, xp.asarray(True), growth)


def code_of(result: Any) -> int:
    """The number behind an item of RESULTS."""
    return int(np.asarray(result._value))


def result_of(code: Any) -> Any:
    """The item of RESULTS with this number, traced or not."""
    result: Any = RESULTS.running
    where: Any = RESULTS.where
    ends = (
        RESULTS.converged,
        RESULTS.max_steps_reached,
        RESULTS.stalled,
        RESULTS.diverged,
        RESULTS.rounded,
        RESULTS.normals_missed,
    )
    if is_concrete(code):
        return next((item for item in ends if code_of(item) == int(code)), RESULTS.running)
    for item in ends:
        result = where(code == code_of(item), item, result)
    return result


@partial(jax.jit, static_argnames="method")
def advance(
    method: AbstractIterativeMethod, problem: Any, limits: Limits, until: Array, carry: Carry
) -> Carry:
    """Iterate up to step `until`, or to the end.

    A fit that stalls or diverges gives back its best net, if the method keeps that.
    """
    running = code_of(RESULTS.running)

    def body(carry: Carry) -> Carry:
        turn = carry.next
        axes = turn.axes(problem)
        pieces = pieces_on(turn.net, *axes)
        measured = method.measure(problem, limits, pieces, carry.measured, carry.exact)
        turn, measured = method.settle(problem, turn, measured)
        records = turn.records.at(turn.step, *problem.summarise(measured, carry.measured))
        if measured.active is not None:
            records = records.counting(turn.step, measured.active, axes)
        turn = eqx.tree_at(lambda t: t.records, turn, records)
        code = _judge(method, limits, turn)
        again = jnp.asarray(False)
        if method.foresees:
            # No fit ends on feet that are only foreseen.
            again = ~carry.exact & (code != running) & (code != code_of(RESULTS.diverged))
            code = jnp.where(again, running, code)
        move = partial(method.move, problem, limits, pieces, measured)
        following = lax.cond((code == running) & ~again, move, lambda turn: turn, turn)
        best = _best(carry.best, turn, measured)
        good = Carry(turn.net, turn.step, following, measured, code, best, again, turn.growth)
        # A step into nonsense is taken back, and leaves no trace.
        back = eqx.tree_at(lambda c: c.code, carry, code)
        bad = (code == code_of(RESULTS.diverged)) & (carry.step >= 0)
        return lax.cond(bad, lambda: back, lambda: good)

    end = lax.while_loop(lambda c: (c.code == running) & (c.next.step <= until), body, carry)
    best = end.best
    if best is None:
        return end
    lost = (end.code == code_of(RESULTS.stalled)) | (end.code == code_of(RESULTS.diverged))
    net, measured = lax.cond(
        lost & (end.step >= 0), lambda: (best.net, best.measured), lambda: (end.net, end.measured)
    )
    return eqx.tree_at(lambda c: (c.net, c.measured), end, (net, measured))


def _best(best: Best | None, turn: Turn, measured: Measured) -> Best | None:
    if best is None:
        return None
    maximum = turn.records.maximum[turn.step]
    return lax.cond(maximum < best.maximum, lambda: Best(turn.net, measured, maximum), lambda: best)


def _judge(method: AbstractIterativeMethod, limits: Limits, turn: Turn) -> Array:
    """Whether a net that has just been measured ends the loop, as the code of one of RESULTS."""
    step, records = turn.step, turn.records
    average, maximum = records.average[step], records.maximum[step]
    finite = jnp.isfinite(average) & jnp.isfinite(maximum) & jnp.all(jnp.isfinite(turn.net))
    met = (average <= limits.average) & (maximum <= limits.maximum)
    outcomes = (
        (~finite | (average > GROWTH * records.average[0]), RESULTS.diverged),
        (met, RESULTS.converged),
        (
            records.is_stalled(step, method.stall_window, method.stall_gain, method.comparable_since),
            RESULTS.stalled,
        ),
        (step >= limits.max_steps, RESULTS.max_steps_reached),
    )
    code = jnp.asarray(code_of(RESULTS.running), jnp.int32)
    for holds, result in reversed(outcomes):
        code = jnp.where(holds, code_of(result), code)
    return code


@jax.custom_jvp
def without_derivative(carry: Carry) -> Carry:
    """The same; differentiating through it raises.

    The derivative of the iteration as run is not that of the fit: feet that start converged never move, so
    their tangents would silently be zero.
    """
    return carry


@without_derivative.defjvp
def _refuse(primals: Any, tangents: Any) -> Any:
    raise TypeError(
        "a fit has no derivative with respect to its data; differentiate functions of the fitted surface, or "
        "closest_point, instead."
    )


def run(
    method: AbstractIterativeMethod,
    problem: Any,
    limits: Limits,
    carry: Carry,
    progress: Callable[[int, int, float, float], None] | None,
) -> Carry:
    """The whole loop: in one go, or in chunks that take about REPORT_SECONDS with a report after each."""
    if progress is None:
        carry = advance(method, problem, limits, limits.max_steps, carry)
        return carry if is_concrete(carry) else without_derivative(carry)
    import time

    most = int(limits.max_steps)
    chunk = FIRST_CHUNK
    while int(carry.code) == code_of(RESULTS.running):
        begun = time.perf_counter()
        until = jnp.asarray(min(int(carry.next.step) + chunk, most), jnp.int32)
        carry = advance(method, problem, limits, until, carry)
        seconds = time.perf_counter() - begun
        step = int(carry.step)
        if step >= 0:
            records = carry.next.records
            progress(step, most, float(records.average[step]), float(records.maximum[step]))
        chunk = max(1, min(2 * chunk, int(chunk * REPORT_SECONDS / max(seconds, 1e-6))))
    return carry
