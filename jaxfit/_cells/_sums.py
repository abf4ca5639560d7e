"""Sums of basis functions over all points, onto the control net.

Within a cell every basis function is a polynomial, so the sums over its points

    sum_k w_k N_i(u_k) N_j(v_k) x_k

are linear images of the moments sum_k w_k s_k^a t_k^b x_k. Moments are sums along a row; rows of
one cell are added up, and the image is one fixed matrix per span and direction.
"""

from functools import reduce
from operator import add, mul

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells._overlap import overlap_add
from jaxfit._cells._polynomials import powers
from jaxfit._splines._pieces import Numbers


def row_moments(
    s: Float[Array, "rows width"],
    t: Float[Array, "rows width"],
    values: Float[Array, "c rows width"],
    order_u: int,
    order_v: int,
) -> Float[Array, "rows K Lc"]:
    """Sums over each row of s^a t^b x, the last index running over b and within it over the values x."""
    product = (powers(t, order_v)[:, None] * values[None]).reshape(-1, *s.shape)
    # One small matrix product a row, each row's sums side by side as the sum over rows reads them.
    across, rows = ((2,), (2,)), ((1,), (1,))
    return lax.dot_general(powers(s, order_u), product, (across, rows), precision=lax.Precision.HIGHEST)


def cells_to_net(
    moments: Float[Array, "cells K Lc"],
    poly_u: Float[Numbers, "spans_u K K"],
    poly_v: Float[Numbers, "spans_v L L"],
) -> Float[Array, "nu nv c"]:
    """One direction at a time: moments into sums for the basis functions of a span, then spans overlapped."""
    (spans_u, order_u, _), (spans_v, order_v, _) = poly_u.shape, poly_v.shape
    x = moments.reshape(spans_u, spans_v, order_u, order_v, -1)
    x = overlap_add(_basis_sums(jnp.reshape(poly_v, (1, spans_v, 1, order_v**2, 1)), x, 3), 1)
    x = overlap_add(_basis_sums(jnp.reshape(poly_u, (spans_u, 1, order_u**2, 1, 1)), x, 2), 0)
    return x.reshape(*x.shape[:2], -1)


def _basis_sums(polynomials: Array, moments: Array, axis: int) -> list[Array]:
    """For each basis function of a span its polynomial's coefficients times the moments along `axis`."""
    x, c = (lax.split(y, (1,) * y.shape[axis], axis) for y in (moments, polynomials))
    return [reduce(add, map(mul, c[k : k + len(x)], x)) for k in range(0, len(c), len(x))]
