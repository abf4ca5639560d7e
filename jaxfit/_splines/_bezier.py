"""Polynomial pieces of curves and surfaces in Bezier form."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxfit._checks import is_concrete
from jaxfit._compile import compiled
from jaxfit._splines._basis import blossom_weights, local_knots
from jaxfit._splines._lookup import windows


class BezierCurves(NamedTuple):
    r"""Pieces $\sum_a B_{s,a} \binom{K-1}{a} x^a (1-x)^{K-1-a}$, $x \in [0, 1]$ on each.

    Attributes
    ----------
    control_points : array (spans, K, d)
    breakpoints : array (spans + 1,)
        Piece $s$ covers the parameters between breakpoints $s$ and $s + 1$.

    Notes
    -----
    Source: NURBS Book, equation (1.7).

    Examples
    --------
    >>> curve = jf.BSplineCurve(np.array([[0.0], [1.0], [0.0]]), np.array([0.0, 0.0, 0.5, 1.0, 1.0]))
    >>> pieces = curve.split()
    >>> print(pieces.breakpoints, pieces.control_points[..., 0].tolist())
    [0.  0.5 1. ] [[0.0, 1.0], [1.0, 0.0]]
    """

    control_points: Float[Array, "spans order d"]
    breakpoints: Float[Array, " breakpoints"]


class BezierPatches(NamedTuple):
    r"""Tensor-product pieces in Bezier form, one per rectangle of non-empty spans.

    Attributes
    ----------
    control_points : array (spans_u, spans_v, K, L, d)
    breakpoints_u : array (spans_u + 1,)
    breakpoints_v : array (spans_v + 1,)

    Examples
    --------
    >>> knots_u, knots_v = np.array([0.0, 0.0, 0.5, 1.0, 1.0]), np.array([0.0, 0.0, 1.0, 1.0])
    >>> patches = jf.BSplineSurface(np.ones((3, 2, 3)), knots_u, knots_v).split()
    >>> patches.control_points.shape
    (2, 1, 2, 2, 3)
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


@compiled
def _bezier_points(control_points: Array, knots: Array, spans: Array) -> Array:
    order = knots.shape[0] - control_points.shape[0]
    local = local_knots(knots, order, spans)
    # Point j takes the end of the span as its last j arguments, and the start as the others.
    at_end = np.arange(order)[None, :] + np.arange(order - 1)[:, None] >= order - 1
    ends = local[order - 2 : order][:, None, :, None]
    arguments = jnp.where(at_end[:, None, :], ends[1], ends[0])
    local = jnp.broadcast_to(local[..., None], (*local.shape, order))
    weights = blossom_weights(local, arguments)
    near = windows(control_points, spans - (order - 1), order)
    return jnp.einsum("rs...,rsj->sj...", near, weights, precision=lax.Precision.HIGHEST)
