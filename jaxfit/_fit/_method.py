"""What an iterative method is: its own state, and five functions that the loop calls."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax import Array
from jaxtyping import Int

from jaxfit._checks import check_kind, check_number
from jaxfit._closest import AbstractFootMethod
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._problem import Problem
from jaxfit._fit._projection import Projection
from jaxfit._fit._working_surface import WorkingSurface


class Iterate(eqx.Module):
    """A surface, the points projected onto it, the method's state, and how many moves led there.

    Before it is measured, `projection` is that of the iterate before.

    Examples
    --------
    >>> u, none = jnp.array([0.25, 0.5]), jnp.zeros(2, jnp.int32)
    >>> projection = jf.Projection(u, u, jnp.zeros(2), none, none == 0, jnp.asarray(2), jnp.asarray(True))
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> surface = jf.WorkingSurface.of(np.zeros((2, 2, 3)), knots, knots)
    >>> iterate = jf.Iterate(surface, projection, state=(), step=jnp.asarray(0))
    >>> iterate.surface.order, int(iterate.step)
    ((2, 2), 0)
    """

    surface: WorkingSurface
    projection: Projection
    state: Any
    step: Int[Any, ""]


class AbstractIterativeMethod(eqx.Module):
    """A method that improves a surface step by step.

    The loop measures a surface, asks the method whether it keeps it, records the errors, decides whether the
    fit ends there, and if not has the method move it:

        surface, state = init(problem, surface, projection)
        repeat:  projection, state = measure(problem, iterate, exact)
                 iterate = accept(problem, old, new)
                 iterate, history = move(problem, iterate, history)
        iterate, stats = postprocess(problem, iterate, stopped_early)

    The state is any pytree of arrays, whose structure and shapes do not change; only the method knows it.
    Everything is in the unit of the problem. `init` may look at values outside transformations; the other
    functions are traced. Python floats among the fields are traced numbers inside them, so that another value
    compiles nothing; all other fields are known before tracing.

    Attributes
    ----------
    stall_window, stall_gain : int, float
        The fit stops as stalled when neither error has fallen by the share `stall_gain` within
        `stall_window` iterations.

    Examples
    --------
    All iterative methods of this library are subclasses. `tests/test_method_contract.py` has a complete
    method written from public names alone.

    >>> method = jf.GeometricApproximation()
    >>> isinstance(method, jf.AbstractIterativeMethod), method.stall_window, method.finds_feet
    (True, 40, True)
    """

    stall_window: eqx.AbstractVar[int]
    stall_gain: eqx.AbstractVar[float]

    @property
    @abstractmethod
    def stall_since(self) -> int:
        """The first iteration whose errors later ones may be compared with."""

    @property
    @abstractmethod
    def finds_feet(self) -> bool:
        """Whether `measure` finds foot points; otherwise it holds the parameters that it is given."""

    @abstractmethod
    def init(
        self, problem: Problem, surface: WorkingSurface, projection: Projection
    ) -> tuple[WorkingSurface, Any]:
        """The surface to begin with, with room for knots if the method inserts any, and the state before
        anything is measured; of `projection` only u and v are known.
        """

    @abstractmethod
    def measure(self, problem: Problem, iterate: Iterate, exact: Array) -> tuple[Projection, Any]:
        """The points projected onto the iterate's surface, and the next state.

        Where `exact`, feet must have converged; elsewhere errors may be predictions.
        """

    @abstractmethod
    def accept(self, problem: Problem, old: Iterate, new: Iterate) -> Iterate:
        """The new iterate, or the old one if that was better; with `new.step` either way.

        Not asked for the first surface.
        """

    @abstractmethod
    def move(self, problem: Problem, iterate: Iterate, history: ErrorHistory) -> tuple[Iterate, ErrorHistory]:
        """The next iterate, one step or more on; several steps record their errors themselves."""

    @abstractmethod
    def postprocess(
        self, problem: Problem, iterate: Iterate, stopped_early: Array
    ) -> tuple[Iterate, dict[str, Any]]:
        """The iterate to return, and what the method reports in the fit's `stats`.

        `stopped_early`: it stalled or diverged, so that an iterate of some steps ago may be the better one.
        """


def dynamic_fields(method: AbstractIterativeMethod) -> tuple[Any, Any]:
    """The fields that are traced numbers, and the others (`equinox.partition`)."""
    return eqx.partition(method, lambda x: isinstance(x, float | np.ndarray | jax.Array))


def check_method(method: Any) -> None:
    """The fields that methods have in common."""
    check_number("stall_window", method.stall_window, 1, whole=True)
    check_number("stall_gain", method.stall_gain, 0.0)
    check_number("foot_tolerance", method.foot_tolerance, 0.0)
    check_kind("foot_method", method.foot_method, AbstractFootMethod, "Newton()")
