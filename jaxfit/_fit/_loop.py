"""The loop of every iterative fit, written once.

A method gives `measure` (feet and errors on the present surface) and `move` (a better net from them). The
loop measures, records, decides, and moves; it ends on a surface that has been measured.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._checks import is_concrete
from jaxfit._fit._results import RESULTS
from jaxfit._precision import bucket
from jaxfit._splines._pieces import Pieces, pieces_on

FIRST_CHUNK = 4  # iterations between two reports of progress, to begin with
REPORT_SECONDS = 0.3
GROWTH = 1e3  # errors beyond this many times the first ones count as divergence


class Measured(eqx.Module):
    """Feet and errors of all points on a surface. Lengths in the unit of the problem."""

    u: Float[Array, " points"]
    v: Float[Array, " points"]
    error: Float[Array, " points"]
    steps: Int[Array, " points"]
    found: Bool[Array, " points"]


class Limits(eqx.Module):
    """When to stop. Tolerances and errors are fractions of the diagonal."""

    average: Float[Array, ""]
    maximum: Float[Array, ""]
    max_steps: Int[Array, ""]


class Carry(eqx.Module):
    """Everything that goes round the loop. `step` is -1 before the first measurement.

    `net` is the one that has been measured, `following` the one the method makes of it.
    """

    step: Int[Array, ""]
    net: Float[Array, "nu nv d"]
    following: Float[Array, "nu nv d"]
    measured: Measured
    average: Float[Array, " steps"]
    maximum: Float[Array, " steps"]
    code: Int[Array, ""]


class AbstractIterativeMethod(eqx.Module):
    """A method that improves a control net step by step. Its fields are known before tracing."""

    stall_window: eqx.AbstractVar[int]
    stall_gain: eqx.AbstractVar[float]

    @abstractmethod
    def measure(self, problem: Any, pieces: Pieces, measured: Measured) -> Measured:
        """Feet on a surface, warm-started from the last ones, and the errors there."""

    @abstractmethod
    def move(self, problem: Any, net: Array, pieces: Pieces, measured: Measured) -> Array:
        """The next control net, from one that has been measured and its pieces."""


def begin(net: Array, u: Array, v: Array, most: int) -> Carry:
    """Before anything is measured; the history holds up to `most` + 1 entries."""
    none = jnp.zeros(u.shape, jnp.int32)
    measured = Measured(u, v, jnp.zeros_like(u), none, none > 0)
    history = jnp.full(bucket(most + 1), jnp.nan, net.dtype)
    running = jnp.asarray(code_of(RESULTS.running), jnp.int32)
    return Carry(jnp.asarray(-1, jnp.int32), net, net, measured, history, history, running)


def code_of(result: Any) -> int:
    """The number behind an item of RESULTS."""
    return int(np.asarray(result._value))


def result_of(code: Array) -> Any:
    """The item of RESULTS with this number, traced or not."""
    result: Any = RESULTS.running
    where: Any = RESULTS.where
    for item in (RESULTS.converged, RESULTS.max_steps_reached, RESULTS.stalled, RESULTS.diverged):
        result = where(code == code_of(item), item, result)
    return result


@partial(jax.jit, static_argnames="method")
def advance(
    method: AbstractIterativeMethod, problem: Any, limits: Limits, until: Array, carry: Carry
) -> Carry:
    """Iterate up to step `until`, or to the end."""
    running = code_of(RESULTS.running)

    def body(carry: Carry) -> Carry:
        net = carry.following
        pieces = pieces_on(net, problem.axis_u, problem.axis_v)
        measured = method.measure(problem, pieces, carry.measured)
        average, maximum = problem.summarise(measured.error)
        following = method.move(problem, net, pieces, measured)
        return _judge(method, limits, carry, (net, following), measured, average, maximum)

    return lax.while_loop(lambda c: (c.code == running) & (c.step < until), body, carry)


def _judge(
    method: AbstractIterativeMethod,
    limits: Limits,
    carry: Carry,
    nets: tuple[Array, Array],
    measured: Measured,
    average: Array,
    maximum: Array,
) -> Carry:
    """Record a measurement, and decide whether the loop goes on."""
    step = carry.step + 1
    averages, maxima = carry.average.at[step].set(average), carry.maximum.at[step].set(maximum)
    finite = jnp.isfinite(average) & jnp.isfinite(maximum) & jnp.all(jnp.isfinite(nets[0]))
    bad = ~finite | (average > GROWTH * averages[0])
    met = (average <= limits.average) & (maximum <= limits.maximum)
    before = jnp.maximum(step - method.stall_window, 0)
    keep = 1.0 - method.stall_gain
    slow = (average > keep * averages[before]) & (maximum > keep * maxima[before])
    slow &= step >= method.stall_window
    outcomes = (
        (bad, RESULTS.diverged),
        (met, RESULTS.converged),
        (slow, RESULTS.stalled),
        (step >= limits.max_steps, RESULTS.max_steps_reached),
    )
    code = jnp.asarray(code_of(RESULTS.running), jnp.int32)
    for holds, result in reversed(outcomes):
        code = jnp.where(holds, code_of(result), code)
    # A step into nonsense is taken back, and leaves no trace in the history either.
    good = Carry(step, *nets, measured, averages, maxima, code)
    taken_back = eqx.tree_at(lambda c: c.code, carry, code)
    return jax.tree.map(lambda a, b: jnp.where(bad & (carry.step >= 0), a, b), taken_back, good)


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
        until = jnp.asarray(min(int(carry.step) + chunk, most), jnp.int32)
        carry = advance(method, problem, limits, until, carry)
        seconds = time.perf_counter() - begun
        step = int(carry.step)
        if step >= 0:
            progress(step, most, float(carry.average[step]), float(carry.maximum[step]))
        chunk = max(1, min(2 * chunk, int(chunk * REPORT_SECONDS / max(seconds, 1e-6))))
    return carry
