"""Geometric interpolation with the feet held: a linear fixed-point iteration on the net (section 3.3.1)."""

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._loop import MAX_GROWTH
from jaxfit._fit._problem import Tolerances
from jaxfit._interpolation._per_point_collocation import PointCollocation


class AbstractAcceleration(eqx.Module):
    """How the moves of a frozen iteration P += W (Q - N P) are made into something faster."""

    needs_spectrum: AbstractClassVar[bool]

    @abstractmethod
    def init(self, net: Float[Array, "d nu nv"], weight: Float[Array, "nu nv"], lowest: Array) -> Any:
        """The state before the first move; `lowest` is the smallest eigenvalue of the collocation matrix."""

    @abstractmethod
    def step(self, shift: Float[Array, "d nu nv"], state: Any) -> tuple[Float[Array, "d nu nv"], Any]:
        """What is added to the net in place of `shift` = W (Q - N P), and the next state."""


class Richardson(AbstractAcceleration):
    """The iteration as it is.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(acceleration=jf.Richardson()).acceleration
    Richardson()
    """

    needs_spectrum: ClassVar[bool] = False

    def init(self, net: Float[Array, "d nu nv"], weight: Float[Array, "nu nv"], lowest: Array) -> Any:
        """Nothing."""
        return ()

    def step(self, shift: Float[Array, "d nu nv"], state: Any) -> tuple[Float[Array, "d nu nv"], Any]:
        """The shift itself."""
        return shift, state


class Chebyshev(AbstractAcceleration):
    r"""Chebyshev's semi-iteration on the spectrum's known bounds.

    The eigenvalues of $N$ lie between $\lambda_{\min}(N_1) \lambda_{\min}(N_2)$, about 1/9 for bicubic
    surfaces, and 1. The error falls by $(\sqrt\kappa - 1) / (\sqrt\kappa + 1)$ an iteration, $\kappa$ being
    the ratio of the bounds: about 0.5, where the plain iteration has 0.9.

    Parameters
    ----------
    margin : float
        By how much the bounds, found at averaged parameters and with weights taken into account, are widened.

    Notes
    -----
    Source: Y. Saad, Iterative Methods for Sparse Linear Systems, second edition (2003), section 12.3.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(acceleration=jf.Chebyshev()).acceleration
    Chebyshev()
    """

    margin: float = 0.1

    needs_spectrum: ClassVar[bool] = True

    def init(self, net: Float[Array, "d nu nv"], weight: Float[Array, "nu nv"], lowest: Array) -> Any:
        """Bounds, the last move, and the recursion's factor."""
        low = (1.0 - self.margin) * jnp.min(weight) * lowest
        high = (1.0 + 0.5 * self.margin) * jnp.max(weight)
        centre, radius = 0.5 * (high + low), 0.5 * (high - low)
        return centre, radius, jnp.zeros_like(net), jnp.zeros_like(centre)

    def step(self, shift: Float[Array, "d nu nv"], state: Any) -> tuple[Float[Array, "d nu nv"], Any]:
        """One step of the three-term recursion."""
        centre, radius, last, factor = state
        fresh = factor == 0
        following = jnp.where(fresh, radius / centre, 1.0 / (2.0 * centre / radius - factor))
        scale = jnp.where(fresh, 1.0 / centre, 2.0 * following / radius)
        move = following * jnp.where(fresh, 0.0, factor) * last + scale * shift
        return move, (centre, radius, move, following)


class FrozenSystem(eqx.Module):
    """What stays the same while the feet are held."""

    collocation: PointCollocation
    target: Float[Array, "d nu nv"]
    weight: Float[Array, "nu nv"]
    held: Bool[Any, "nu nv"]  # control points that do not move and count for no error
    lowest: Float[Array, ""]
    diagonal: Float[Array, ""]


def iterate_frozen(
    method: Any,
    limits: Tolerances,
    system: FrozenSystem,
    most: Array,
    net: Float[Array, "nu nv d"],
    first: Array,
    history: ErrorHistory,
) -> tuple[Float[Array, "nu nv d"], Array, ErrorHistory]:
    """Moves with the feet held, at least one and up to `most`, until errors meet the tolerances or stall.

    Records the errors at the held feet, but those of step `first`, which is known exactly. Unless `most`
    ended it, the net it ends with has been recorded.
    """
    is_close, times_close = system.collocation.is_close(), system.collocation.times_close()
    last = first + most
    exact = history.at(first)
    acceleration: AbstractAcceleration = method.acceleration

    def body(x: tuple[Array, Array, Array, ErrorHistory, Any]) -> Any:
        _, net, step, history, state = x
        e = system.target - lax.cond(is_close, times_close, lambda net: system.collocation.times(net), net)
        square: Any = sum(e[1:] ** 2, e[0] ** 2)
        error = jnp.where(system.held, 0.0, jnp.sqrt(square)) / system.diagonal
        average, maximum = jnp.mean(error), jnp.max(error)
        history = history.append(step, (average, maximum, 0.0, 0.0))
        met = (average <= limits.average) & (maximum <= limits.maximum)
        sound = jnp.isfinite(average) & (average <= MAX_GROWTH * history.first)
        stalled = history.is_stalled(step, method.stall_window, method.stall_gain)
        on = (step == first) | (sound & ~met & (step < limits.max_steps) & ~stalled)
        still = system.held | (error <= limits.maximum) if method.local else system.held
        shift = jnp.where(still[None], 0.0, system.weight[None] * e)
        move, state = acceleration.step(shift, state)
        return on, net + jnp.where(on, move, 0.0), step + on, history, state

    net = jnp.moveaxis(net, -1, 0)
    state = acceleration.init(net, system.weight, system.lowest)
    begin = (jnp.asarray(True), net, first, history, state)
    _, net, step, history, _ = lax.while_loop(lambda x: x[0] & (x[2] < last), body, begin)
    # The first entry is that of the exact errors, which the loop has written over.
    return jnp.moveaxis(net, 0, -1), step, history.append(first, exact)
