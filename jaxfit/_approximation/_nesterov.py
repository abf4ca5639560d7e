"""`Nesterov`: accelerated gradient steps."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._checks import is_concrete

# Eigenvalues of the plain iteration times its relaxation must stay below this.
LARGEST_RELAXATION = 4 / 3


class Momentum(eqx.Module):
    """The net X_n that the last step led to, and t_n."""

    net: Float[Any, "nu nv d"]
    weight: Float[Any, ""]


def zero_momentum(net: Any) -> Momentum:
    """No momentum."""
    xp: Any = np if is_concrete(net) else jnp
    return Momentum(net, xp.ones((), net.dtype))


class Nesterov(eqx.Module):
    r"""Nesterov's acceleration: the net is extrapolated along its last move.

    With $X_n$ the net after step n, the next step starts from

    $$P_n = X_n + \frac{t_n - 1}{t_{n+1}} (X_n - X_{n-1}), \qquad
      t_{n+1} = \tfrac{1}{2} \Big(1 + \sqrt{1 + 4 t_n^2}\Big), \qquad t_1 = 1.$$

    The number of plain steps grows with the condition number of the problem, that of accelerated steps with
    its square root. The sequence restarts whenever the average error has risen, and where fairing or new
    knots have changed the net.

    Source: Y. Nesterov, Soviet Mathematics Doklady 27, 1983; B. O'Donoghue and E. Candes, Adaptive restart
    for accelerated gradient schemes, Foundations of Computational Mathematics 15, 2015.

    Examples
    --------
    >>> jf.GeometricApproximation(acceleration=jf.Nesterov()).acceleration
    Nesterov()
    """

    def __call__(
        self, momentum: Momentum, reached: Float[Array, "nu nv d"], rising: Array
    ) -> tuple[Float[Array, "nu nv d"], Momentum]:
        """The net to go on from; `rising` says whether the error has risen."""
        weight = jnp.where(rising, 1.0, momentum.weight)
        following = 0.5 * (1.0 + jnp.sqrt(1.0 + 4.0 * weight**2))
        beyond = reached + ((weight - 1.0) / following) * (reached - momentum.net)
        return beyond, Momentum(reached, following)
