"""Polynomial pieces of curves and surfaces in Bezier form."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit._checks import is_concrete
from jaxfit._splines._basis import blossom_weights, local_knots


class BezierCurves(NamedTuple):
    r"""Pieces $\sum_a B_{s,a} \binom{K-1}{a} x^a (1-x)^{K-1-a}$, $x \in [0, 1]$ on each.

    Attributes
    ----------
    control_points : array (spans, K, d)
    breakpoints : array (spans + 1,)
        Piece $s$ covers the parameters between breakpoints $s$ and $s + 1$.
    """

    control_points: Float[Array, "spans order d"]
    breakpoints: Float[Array, " breakpoints"]


class BezierPatches(NamedTuple):
    """Tensor-product pieces, one per rectangle of non-empty spans.

    Attributes
    ----------
    control_points : array (spans_u, spans_v, K, L, d)
    breakpoints_u : array (spans_u + 1,)
    breakpoints_v : array (spans_v + 1,)
    """

    control_points: Float[Array, "spans_u spans_v K L d"]
    breakpoints_u: Float[Array, " breakpoints_u"]
    breakpoints_v: Float[Array, " breakpoints_v"]


def bezier_along(
    control_points: Float[Array, "n ..."], knots: Float[Array, " knots"], name: str
) -> tuple[Float[Array, "spans order ..."], Float[Array, " breakpoints"]]:
    r"""Bezier points along the first axis: the blossom $f(a^{K-1-j}, b^j)$ on each span $[a, b]$.

    The same points as repeated knot insertion (NURBS Book, algorithm A5.6); all weights lie
    between 0 and 1.
    """
    if not is_concrete(knots):
        raise TypeError(
            f"{name} must be concrete to split at the knots, but is traced; call split() outside "
            "jit, or close over the knots."
        )
    count = control_points.shape[0]
    order = knots.shape[0] - count
    values = np.asarray(knots)
    spans = order - 1 + np.flatnonzero(np.diff(values[order - 1 : count + 1]) > 0)
    pieces = _bezier_points(control_points, knots, jnp.asarray(spans))
    return pieces, jnp.asarray(np.append(values[spans], values[spans[-1] + 1]))


@jax.jit
def _bezier_points(control_points: Array, knots: Array, spans: Array) -> Array:
    order = knots.shape[0] - control_points.shape[0]
    shape = (spans.shape[0], order)
    local = [jnp.broadcast_to(t[:, None], shape) for t in local_knots(knots, order, spans)]
    start, stop = local[order - 2], local[order - 1]
    position = jnp.broadcast_to(jnp.arange(order)[None, :], shape)
    arguments = [jnp.where(position >= step, stop, start) for step in range(1, order)]
    weights = blossom_weights(local, arguments, jnp.ones(shape, knots.dtype))
    pieces = jnp.zeros((*shape, *control_points.shape[1:]), control_points.dtype)
    for r, w in enumerate(weights):
        weight = w.reshape(*shape, *(1,) * (control_points.ndim - 1))
        pieces = pieces + weight * control_points[spans - (order - 1) + r][:, None]
    return pieces
