"""Sums of basis functions over all points, onto the control net.

Within a cell every basis function is a polynomial, so the sums over its points

    sum_k w_k N_i(u_k) N_j(v_k) x_k

are linear images of the moments sum_k w_k s_k^a t_k^b x_k. Moments are sums along a row; rows of
one cell are added up, and the image is one fixed matrix per span and direction.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells._rows import Rows
from jaxfit._splines._pieces import Numbers


def net_sums(
    rows: Rows,
    s: Float[Array, "rows width"],
    t: Float[Array, "rows width"],
    values: Float[Array, "c rows width"],
    poly_u: Float[Numbers, "spans_u K K"],
    poly_v: Float[Numbers, "spans_v L L"],
) -> Float[Array, "nu nv c"]:
    """sum_k N_i(u_k) N_j(v_k) values_k for every control point, empty slots having values 0.

    `poly_u`, `poly_v` are the basis functions as polynomials (`span_polynomials`).
    """
    moments = row_moments(s, t, values, poly_u.shape[1], poly_v.shape[1])
    spans_u, spans_v = poly_u.shape[0], poly_v.shape[0]
    cells = jax.ops.segment_sum(moments, rows.cell, spans_u * spans_v, indices_are_sorted=True)
    return cells_to_net(cells, poly_u, poly_v)


def row_moments(
    s: Float[Array, "rows width"],
    t: Float[Array, "rows width"],
    values: Float[Array, "c rows width"],
    order_u: int,
    order_v: int,
) -> Float[Array, "rows K Lc"]:
    """Sums over each row of s^a t^b x, the last index running over b and within it over the values x."""
    powers_s, powers_t = _powers(s, order_u), _powers(t, order_v)
    product = (powers_t[:, None] * values[None]).reshape(-1, *s.shape)
    # One small matrix product a row, each row's sums side by side as the sum over rows reads them.
    across, rows = ((2,), (2,)), ((1,), (1,))
    return lax.dot_general(powers_s, product, (across, rows), precision=lax.Precision.HIGHEST)


def _powers(x: Float[Array, "rows width"], order: int) -> Float[Array, "order rows width"]:
    powers = [jnp.ones_like(x)]
    for _ in range(order - 1):
        powers.append(powers[-1] * x)
    return jnp.stack(powers)


def cells_to_net(
    moments: Float[Array, "cells K Lc"],
    poly_u: Float[Numbers, "spans_u K K"],
    poly_v: Float[Numbers, "spans_v L L"],
) -> Float[Array, "nu nv c"]:
    """One direction at a time: moments into sums for the basis functions of a span, then spans overlapped."""
    (spans_u, order_u, _), (spans_v, order_v, _) = poly_u.shape, poly_v.shape
    x = moments.reshape(spans_u, spans_v, order_u, order_v, -1)
    terms = [
        sum(poly_v[None, :, None, q, b, None] * x[:, :, :, b] for b in range(order_v)) for q in range(order_v)
    ]
    x = _overlapped(terms, 1)
    terms = [sum(poly_u[:, None, r, a, None] * x[:, :, a] for a in range(order_u)) for r in range(order_u)]
    return _overlapped(terms, 0)


def _overlapped(terms: list[Any], axis: int) -> Any:
    """The sum of the terms, each one place farther along `axis`."""
    shape, size = list(terms[0].shape), terms[0].shape[axis]
    shape[axis] += len(terms) - 1
    total = jnp.zeros(shape, terms[0].dtype)
    for i, x in enumerate(terms):
        total = total.at[(slice(None),) * axis + (slice(i, i + size),)].add(x)
    return total
