"""`ControlPointSums`: the weighted sums of error vectors that Algorithm 1 moves control points by."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._barrier import materialise
from jaxfit._cells import Rows, cells_to_net, row_moments
from jaxfit._checks import is_concrete
from jaxfit._closest import PointSums, dot
from jaxfit._splines._pieces import Pieces
from jaxfit._unrolling import root


class WeightedErrors(eqx.Module):
    """sum_k w_k N_i N_j e_k, e_k = Q_k - R, and, last, sum_k w_k N_i N_j for every control point."""

    sums: Float[Any, "nu nv c"]

    @property
    def means(self) -> Float[Array, "nu nv d"]:
        """Weighted means of the residuals e_k around each control point, 0 where no point has influence."""
        total = self.sums[..., -1:]
        touched = total > 0
        return jnp.where(touched, self.sums[..., :-1] / jnp.where(touched, total, 1.0), 0.0)


class ControlPointSums(PointSums):
    r"""Sums over all points for each control point, accumulated while feet are updated.

    `update_feet` gives an object with `means` (nu, nv, d), the weighted means of the residuals
    $e_k = Q_k - R(u_k, v_k)$: $\sum_k w_k N_i N_j e_k / \sum_k w_k N_i N_j$, 0 where no point has influence.
    Kept as `sums` of a state it is added up over devices. A state begins with `zeros`.

    Parameters
    ----------
    weigh : function, optional
        `weigh(weight, error)` gives the weights that count, from those of the points and the lengths of their
        residuals, arrays of any shape. By default the weights of the points count.

    Notes
    -----
    The numerators and denominators of Algorithm 1, section 4.1 of Kineri, Wang, Lin and Maekawa (2012). Pass
    it to `update_feet` as `sums`.

    Examples
    --------
    >>> jf.ControlPointSums().zeros(np.ones((5, 4, 3))).means.shape
    (5, 4, 3)
    >>> jf.ControlPointSums(lambda weight, error: weight / (1 + error)).weigh(1.0, 3.0)
    0.25
    """

    weigh: Callable[[Array, Array], Array] | None = None

    def zeros(self, net: Float[Any, "nu nv d"]) -> WeightedErrors:
        """What there is for no points, for a net of this shape: `sums` of a first state."""
        xp: Any = np if is_concrete(net) else jnp
        return WeightedErrors(xp.zeros((*net.shape[:2], net.shape[2] + 1), net.dtype))

    def begin(self, pieces: Pieces) -> Float[Array, "cells K Lc"]:
        """Zeros for each cell."""
        cells, d, order_u, order_v = pieces.coefficients.shape
        return jnp.zeros((cells, order_u, order_v * (d + 1)), pieces.coefficients.dtype)

    def add(
        self,
        total: Float[Array, "cells K Lc"],
        part: Rows,
        s: Float[Array, "rows width"],
        t: Float[Array, "rows width"],
        e: Float[Array, "d rows width"],
        weight: Float[Array, "rows width"],
    ) -> Float[Array, "cells K Lc"]:
        """The total with the moments of the points in some rows added."""
        order_u, columns = total.shape[1:]

        def summands(e: Array, weight: Array) -> Array:
            if self.weigh is not None:
                weight = self.weigh(weight, root(dot(e, e)))
            return jnp.concatenate([weight[None] * e, weight[None]])

        values = materialise(part.used > 0, summands, e, weight)
        moments = row_moments(s, t, values, order_u, columns // values.shape[0])
        return total.at[part.cell].add(moments, mode="promise_in_bounds", wrap_negative_indices=False)

    def finish(self, total: Float[Array, "cells K Lc"], pieces: Pieces) -> WeightedErrors:
        """The sums at the control points."""
        sums = cells_to_net(total, pieces.axis_u.polynomials, pieces.axis_v.polynomials)
        return WeightedErrors(_above_rounding(sums, pieces.order))


def _above_rounding(sums: Array, order: tuple[int, int]) -> Array:
    """The sums, with 0 where the sum of weights is so small that rounding decides it.

    Rounding errors are as large as the sums of the control points in the same cells make them.
    """
    total = lax.stop_gradient(sums[..., -1:])
    largest = total
    for window in ((2 * order[0] - 1, 1, 1), (1, 2 * order[1] - 1, 1)):
        largest = lax.reduce_window(largest, 0.0, lax.max, window, (1, 1, 1), "SAME")
    return jnp.where(total > jnp.finfo(sums.dtype).eps ** 0.75 * largest, sums, 0.0)
