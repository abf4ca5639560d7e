"""`AbstractIterativeMethod`, the contract between the loop and a method, and `Iterate`."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jax import Array
from jaxtyping import Float, Int

from jaxfit._checks import Scalar
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._problem import Problem
from jaxfit._fit._stationarity_condition import StationarityCondition
from jaxfit._fit._working_surface import WorkingSurface


class Iterate(eqx.Module):
    """A surface, the projection of the points onto it, the method's state, and the number of moves so far.

    Attributes
    ----------
    surface : WorkingSurface
    projection : FootPoints
        Until the surface has been measured, that of the last iterate.
    state : pytree
        What the method remembers.
    step : array () of int
        The number of moves so far.

    Examples
    --------
    >>> u, none = jnp.array([0.25, 0.5]), jnp.zeros(2, jnp.int32)
    >>> projection = jf.FootPoints(u, u, jnp.zeros(2), none, none == 0, jnp.asarray(2), jnp.asarray(True))
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> surface = jf.WorkingSurface.of(np.zeros((2, 2, 3)), knots, knots)
    >>> iterate = jf.Iterate(surface, projection, state=(), step=jnp.asarray(0))
    >>> iterate.surface.order, int(iterate.step)
    ((2, 2), 0)
    """

    surface: WorkingSurface
    projection: FootPoints
    state: Any
    step: Int[Any, ""]


class AbstractIterativeMethod(eqx.Module):
    """A method that improves a surface step by step. Subclass it to write one of your own.

    The loop measures a surface, asks the method whether it accepts it, records the errors and decides whether
    the fit ends. If not, the method moves the surface:

        surface, state = init(problem, surface, projection)
        repeat:  projection, state = measure(problem, iterate, exact)
                 iterate = accept(problem, old, new)
                 iterate, history = move(problem, iterate, history)
        iterate, stats = postprocess(problem, iterate, stopped_early)

    These five functions are called by the loop only. Lengths are in the unit of the problem, in which the
    diagonal of the data is about 1, and errors in the history are fractions of that diagonal. Points are
    padded, and those of weight 0 must not influence the surface.

    The state is any pytree of arrays whose structure, shapes and dtypes do not change. What a method
    remembers from one function to the next has to be in it. The loop uses none of it but an attribute `sums`,
    if there is one: after `measure` it adds these up over the devices among which the points are divided.
    Outside transformations `init` is called with NumPy arrays, and its state had better hold NumPy's, which
    compile nothing; the other functions are always traced, so they use `jnp.where` and `lax.cond` instead of
    `if`.

    A method is an `equinox.Module`, and its fields are its options. Fields that are Python floats are traced,
    so that another value compiles nothing; all others, such as a border, are static and must be hashable. The
    properties below may be plain class attributes, as in `stall_since = 0`.

    Attributes
    ----------
    stall_window, stall_gain : int, float
        Fields that a method must have, by custom 20 to 40 iterations and 1e-3 to 1e-2. The fit stops as
        stalled when neither error has fallen by the share `stall_gain` within `stall_window` iterations.

    Examples
    --------
    All iterative methods of this library are subclasses. `tests/test_method_contract.py` has a complete
    method written from public names alone.

    >>> method = jf.GeometricApproximation()
    >>> isinstance(method, jf.AbstractIterativeMethod), method.stall_window, method.finds_feet
    (True, 40, True)
    """

    stall_window: eqx.AbstractVar[int]
    stall_gain: eqx.AbstractVar[Scalar]

    @property
    def stall_after(self) -> int:
        """The window that the loop sees: the field `stall_window`, unless the method knows better."""
        return self.stall_window

    @property
    @abstractmethod
    def stall_since(self) -> int:
        """The first iteration whose errors later ones may be compared with."""

    @property
    @abstractmethod
    def finds_feet(self) -> bool:
        """Whether `measure` finds foot points. If not, it keeps the parameters that it is given."""

    @abstractmethod
    def init(
        self, problem: Problem, surface: WorkingSurface, projection: FootPoints
    ) -> tuple[WorkingSurface, Any]:
        """The surface to begin with, usually `surface` itself, and the first state.

        Of `projection` only u and v are known. A method that inserts knots returns `surface.padded(...)`:
        arrays cannot grow later.
        """

    @abstractmethod
    def measure(self, problem: Problem, iterate: Iterate, exact: Array) -> tuple[FootPoints, Any]:
        """The projection of the points onto the iterate's surface, and the next state.

        Start from `iterate.projection`, the feet on the surface before. Where `exact` (traced) holds, feet
        must have converged, as those of `update_feet` have by default; otherwise errors may be predictions,
        if `FootPoints.exact` says so.
        """

    @abstractmethod
    def accept(self, problem: Problem, old: Iterate, new: Iterate) -> Iterate:
        """The new iterate, or the old one if that was better; with `new.step` in both cases.

        Not called for the first surface.
        """

    @abstractmethod
    def move(self, problem: Problem, iterate: Iterate, history: ErrorHistory) -> tuple[Iterate, ErrorHistory]:
        """The next iterate: another surface, `iterate.projection`, the next state, and `iterate.step + 1`.

        `history` ends with the errors of `iterate`, `history.at(iterate.step)`, and is returned as it is.
        Only a method that makes several steps in one move records their errors itself, by `history.append`.
        """

    @abstractmethod
    def postprocess(
        self, problem: Problem, iterate: Iterate, stopped_early: Array
    ) -> tuple[Iterate, dict[str, Any]]:
        """The iterate to return, usually `iterate` itself, and the method's entries of the fit's `stats`.

        `stopped_early` is True if the fit stalled or diverged (not at `max_steps`), so that an earlier
        iterate, if the state holds one with its projection, may be better.
        """

    def stationarity(
        self, problem: Problem, surface: WorkingSurface, state: Any, error: Float[Any, " points"]
    ) -> StationarityCondition:
        """The condition that the method's final surface meets, for the derivative of its fits.

        `state` is the last one, and `error` are the distances of the points, here those of `surface`. It is
        differentiated with respect to the points, the weights, the control points and the method's numbers,
        so these have to come from the arguments, not from the state. A method need not have this function;
        its fits then have no derivative but that of `UnrolledAdjoint`, which needs nothing of a method whose
        loops are those of `update_feet`.
        """
        raise TypeError(
            f"a fit by {type(self).__name__} has no derivative, since it names no condition that its final "
            "surface meets; give it a function `stationarity`, or pass adjoint=UnrolledAdjoint()."
        )
