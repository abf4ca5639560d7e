"""`Fairing`: smoothing of a control net between iterations (section 4.3 of the paper)."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._checks import check_number


class Fairing(eqx.Module):
    r"""Every so many iterations each interior control point becomes a mean of its 3 x 3 neighbours (Box III).

    The weights are 1 for itself, $e^{-\gamma}$ for the four nearest and $e^{-2\gamma}$ for the four diagonal
    ones, over their sum; all points move at once, after the iteration's own move. Fairing improves the shape
    and does not lower errors: they rise and fall again within a few iterations.

    Parameters
    ----------
    every : int
        Iterations from one fairing to the next (default 20).
    gamma : float
        At least 0 (default 2); fairing is weaker for greater values.

    Raises
    ------
    ValueError
        If `every` is no whole number of at least 1, or `gamma` is negative or not finite.

    Examples
    --------
    With gamma = 0 the interior control point becomes the mean of all nine:

    >>> net, held = np.zeros((3, 3, 1)), np.zeros((3, 3), bool)
    >>> net[1, 1] = 9.0
    >>> jf.Fairing(gamma=0.0)(jnp.asarray(net), jnp.asarray(held))[1, 1].tolist()
    [1.0]
    """

    every: int = 20
    gamma: float = 2.0

    def __check_init__(self) -> None:
        check_number("every", self.every, 1, whole=True)
        check_number("gamma", self.gamma, 0.0)

    def __call__(self, net: Float[Array, "nu nv d"], held: Bool[Array, "nu nv"]) -> Float[Array, "nu nv d"]:
        """The faired net; its border and `held` control points do not move."""
        near = jnp.exp(-jnp.asarray(self.gamma, net.dtype))
        total = 1.0 + 4.0 * near + 4.0 * near**2
        # The mean is a product of one along each direction.
        rows = net[1:-1] + near * (net[:-2] + net[2:])
        inner = (rows[:, 1:-1] + near * (rows[:, :-2] + rows[:, 2:])) / total
        return jnp.where(held[..., None], net, net.at[1:-1, 1:-1].set(inner))
