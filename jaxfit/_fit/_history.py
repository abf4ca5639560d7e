"""`ErrorHistory`, the record of the loop, and `History`, the same for users."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._checks import is_concrete
from jaxfit._precision import bucket

LEAST_ENTRIES = 1024  # so that other limits on the iterations compile nothing
MOST_ENTRIES = 1 << 16  # the last so many iterations are kept


class ErrorHistory(eqx.Module):
    """One entry for each iteration, NaN where there is none yet. New entries replace the oldest ones.

    Attributes
    ----------
    errors : array (4, steps)
        Average and maximum error as fractions of the diagonal; evaluations of the surface per foot, and
        change of a foot's parameters since the iteration before, both on average.
    counts : array (3, steps) of int
        Points that took part, and control points along u and v.
    first : array ()
        The average error of the first surface.

    Examples
    --------
    >>> history = jax.tree.map(jnp.asarray, jf.ErrorHistory.empty(max_steps=10, dtype=np.float32))
    >>> history = history.append(jnp.asarray(0), (0.5, 1.0, 3.0, 0.0), jnp.array([60, 6, 5], jnp.int32))
    >>> history.at(jnp.asarray(0)).tolist()
    [0.5, 1.0, 3.0, 0.0]
    """

    errors: Float[Any, "4 steps"]
    counts: Int[Any, "3 steps"]
    first: Float[Any, ""]

    @staticmethod
    def empty(max_steps: int, dtype: Any) -> "ErrorHistory":
        """A history with room for all iterations, or for the last MOST_ENTRIES."""
        entries = min(bucket(max_steps + 1, LEAST_ENTRIES), MOST_ENTRIES)
        nothing, none = np.full((4, entries), np.nan, dtype), np.zeros((3, entries), np.int32)
        return ErrorHistory(nothing, none, np.asarray(np.nan, dtype))

    @property
    def capacity(self) -> int:
        """How many iterations are kept."""
        return self.errors.shape[1]

    def append(self, step: Array, errors: Any, counts: Any = None) -> "ErrorHistory":
        """The history with the entry of iteration `step`; without `counts` the last ones are repeated."""
        entry = jnp.asarray(errors, self.errors.dtype)
        at = step % self.capacity
        first = jnp.where(step == 0, entry[0], self.first)
        if counts is None:
            counts = self.counts[:, (step - 1) % self.capacity]
        return ErrorHistory(self.errors.at[:, at].set(entry), self.counts.at[:, at].set(counts), first)

    def at(self, step: Array) -> Float[Array, "4"]:
        """Average, maximum, evaluations and change of an iteration; `iterate.step` is the last one."""
        return self.errors[:, step % self.capacity]

    def has_risen(self, step: Array) -> Array:
        """Whether the average error is greater than in the iteration before."""
        return self.at(step)[0] > self.at(jnp.maximum(step - 1, 0))[0]

    def is_stalled(self, step: Array, window: int, gain: Any, since: int = 0) -> Array:
        """Whether neither error has fallen by the share `gain` within `window` iterations.

        Iterations before `since` do not count.
        """
        now, before = self.at(step)[:2], self.at(jnp.maximum(step - window, 0))[:2]
        return jnp.all(now > (1.0 - gain) * before) & (step >= window + since)


class History(eqx.Module):
    """Errors and counts of every iteration, the first surface included.

    Attributes
    ----------
    average, maximum : array (steps,)
        Errors as fractions of the diagonal, at local feet, or at the parameters while a method holds these.
        Predicted ones where a method has `single_step`.
    evaluations : array (steps,)
        Evaluations of the surface per foot, averaged over the points.
    change : array (steps,)
        Change of a foot's parameters (u plus v) since the iteration before, averaged over the points.
    active : array (steps,) of int
        Points that took part.
    net : array (steps, 2) of int
        Control points along u and v.
    faired, refined : array (steps,) of bool
        Whether fairing or new knots changed the surface in this iteration.

    Notes
    -----
    The last 65,536 iterations are kept. Inside a transformation the number of iterations is not known: the
    arrays have room for more and end in NaN.

    Examples
    --------
    >>> errors, none = jnp.array([0.02, 0.005]), jnp.zeros(2)
    >>> history = jf.History(average=errors, maximum=3 * errors, evaluations=none, change=none)
    >>> round(float(history.average[0] / history.average[-1]), 3)
    4.0
    """

    average: Float[Array, " steps"]
    maximum: Float[Array, " steps"]
    evaluations: Float[Array, " steps"]
    change: Float[Array, " steps"]
    active: Int[Array, " steps"] | None = None
    net: Int[Array, "steps 2"] | None = None
    faired: Bool[Array, " steps"] | None = None
    refined: Bool[Array, " steps"] | None = None


def public_history(history: ErrorHistory, last_step: Any, fairing: Any = None) -> History:
    """The history for users, cut to the iterations made where their number is known."""
    concrete = is_concrete(history, last_step)
    xp: Any = np if concrete else jnp  # cut by NumPy: by JAX, every new length would be a new compilation
    errors, counts = xp.asarray(history.errors), xp.asarray(history.counts)
    step = np.arange(history.capacity)
    if concrete:
        made = int(last_step) + 1
        step = np.arange(max(made - history.capacity, 0), made)
        errors, counts = (x[:, step % history.capacity] for x in (errors, counts))
    faired = np.zeros(step.shape, bool) if fairing is None else (step > 0) & (step % fairing.every == 0)
    net = counts[1:].T
    refined = xp.any(net > xp.concatenate([net[:1], net[:-1]]), axis=1)
    parts = [*errors, counts[0], net, xp.asarray(faired), refined]
    return History(*(jax.device_put(parts) if concrete else (jnp.asarray(x) for x in parts)))
