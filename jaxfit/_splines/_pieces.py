"""A spline as polynomials, one per cell: what every fast evaluation and every fit stands on.

A *cell* is a knot-span rectangle. With K - 1 and L - 1 the degrees, the surface on a cell is

    R(u, v) = sum_ab C[cell, :, a, b] s^a t^b,      s, t in [-1, 1],

with local coordinates s = (u - centre_u) / half_u and likewise t. On [-1, 1], unlike [0, 1], the
monomials of low degree are well conditioned, so little is lost against the recursion. A curve is the
same with a single cell and order 1 in v.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

FEW = 4096


class Axis(eqx.Module):
    """One direction of the cells: break points, and the smooth stretches between creases.

    A crease is a knot of multiplicity order - 1 or more, where the tangent may jump. `low` and `high`
    bound the stretch without creases inside that a cell lies in; `first` and `last` are the cells at
    the ends of that stretch. `ends` are the first and the last cell of positive width, `before` and
    `after` the cells across the creases on either side (the cell itself at the ends of the domain).
    """

    breaks: Float[Array, " breaks"]
    low: Float[Array, " cells"]
    high: Float[Array, " cells"]
    first: Int[Array, " cells"]
    last: Int[Array, " cells"]
    ends: Int[Array, "2"]
    before: Int[Array, " cells"]
    after: Int[Array, " cells"]

    @property
    def cells(self) -> int:
        """Number of knot spans, empty ones included (so that it depends on shapes only)."""
        return self.low.shape[0]

    @property
    def centre(self) -> Float[Array, " cells"]:
        """Middle of every span."""
        return 0.5 * (self.breaks[1:] + self.breaks[:-1])

    @property
    def half(self) -> Float[Array, " cells"]:
        """Half the width of every span; 1 for an empty one, which no parameter falls into."""
        width = self.breaks[1:] - self.breaks[:-1]
        return jnp.where(width > 0, 0.5 * width, 1.0)

    def locate(self, u: Float[Array, "..."]) -> Int[Array, "..."]:
        """Span with breaks[i] <= u < breaks[i+1]; the last non-empty one at the right end."""
        if u.size <= FEW:  # comparing with all breaks is quick, and much quicker to compile
            inner = jnp.sum(self.breaks.reshape((1,) * u.ndim + (-1,)) <= u[..., None], axis=-1) - 1
        else:
            inner = self._bisect(u)
        return jnp.clip(inner, self.ends[0], self.ends[1]).astype(jnp.int32)

    def _bisect(self, u: Float[Array, "..."]) -> Int[Array, "..."]:
        # As jnp.searchsorted, without its care for NaN and signed zeros, which doubles the work.
        found = jnp.zeros(u.shape, jnp.int32)
        for bit in reversed(range(self.cells.bit_length())):
            trial = found + (1 << bit)
            inside = trial <= self.cells
            passed = self.breaks[jnp.minimum(trial, self.cells)] <= u
            found = jnp.where(inside & passed, trial, found)
        return found


class Pieces(eqx.Module):
    """Polynomial pieces of a surface, `coefficients[cell_u * cells_v + cell_v, coordinate, a, b]`."""

    coefficients: Float[Array, "cells d K L"]
    axis_u: Axis
    axis_v: Axis

    @property
    def cells(self) -> int:
        """Number of cells, empty ones included."""
        return self.coefficients.shape[0]

    @property
    def order(self) -> tuple[int, int]:
        """Degree + 1 along u and along v."""
        return self.coefficients.shape[2], self.coefficients.shape[3]


def make_axis(knots: Float[Array, " knots"], order: int) -> Axis:
    """The spans of a knot vector's domain, with the smooth stretches they belong to."""
    breaks = knots[order - 1 : knots.shape[0] - order + 1]
    cells = breaks.shape[0] - 1
    number = jnp.arange(cells, dtype=jnp.int32)
    repeats = jnp.sum(breaks[:, None] == knots[None, :], axis=1)
    crease = repeats >= max(order - 1, 1)
    crease = crease.at[0].set(True).at[-1].set(True)
    filled = breaks[1:] > breaks[:-1]
    # The nearest crease to the left and to the right; empty spans neither start nor end a stretch.
    first = lax.cummax(jnp.where(crease[:-1] & filled, number, 0))
    last = lax.cummin(jnp.where(crease[1:] & filled, number, cells - 1), reverse=True)
    ends = jnp.stack([jnp.argmax(filled), cells - 1 - jnp.argmax(filled[::-1])]).astype(jnp.int32)
    # The filled cell on the other side of a crease; empty spans may lie between.
    left = lax.cummax(jnp.where(filled, number, -1))[jnp.maximum(first - 1, 0)]
    right = lax.cummin(jnp.where(filled, number, cells), reverse=True)
    right = right[jnp.minimum(last + 1, cells - 1)]
    before = jnp.where(first > ends[0], left, number)
    after = jnp.where(last < ends[1], right, number)
    return Axis(breaks, breaks[first], breaks[last + 1], first, last, ends, before, after)


def span_polynomials(knots: Float[Array, " knots"], order: int) -> Float[Array, "spans K K"]:
    """Non-zero basis functions of every span as polynomials, M[span, r, a] of s^a, s in [-1, 1].

    The Cox-de Boor recursion, (2)-(3) in the paper, carried out on coefficients: each of its factors
    is a polynomial of degree one in s. Empty spans give finite values that nothing uses.
    """
    axis = make_axis(knots, order)
    centre, half = axis.centre, axis.half
    spans = axis.cells

    def knot(offset: int) -> Float[Array, " spans"]:
        return lax.slice_in_dim(knots, order - 1 + offset, order - 1 + offset + spans)

    zero = jnp.zeros((spans, order), knots.dtype)
    basis = [zero.at[:, 0].set(1.0)]
    for degree in range(1, order):
        raised = [zero] * (degree + 1)
        for r in range(degree):
            left, right = knot(r + 1 - degree), knot(r + 1)
            width = right - left
            share = jnp.where(width > 0, 1.0, 0.0) / jnp.where(width > 0, width, 1.0)
            scaled = basis[r] * share[:, None]
            raised[r] = raised[r] + _times_linear(scaled, right - centre, -half)
            raised[r + 1] = raised[r + 1] + _times_linear(scaled, centre - left, half)
        basis = raised
    return jnp.stack(basis, axis=1)


def _times_linear(
    p: Float[Array, "spans K"], constant: Float[Array, " spans"], slope: Float[Array, " spans"]
) -> Float[Array, "spans K"]:
    """(constant + slope s) p(s), the highest coefficient of p being zero."""
    shifted = jnp.concatenate([jnp.zeros_like(p[:, :1]), p[:, :-1]], axis=1)
    return constant[:, None] * p + slope[:, None] * shifted


def make_pieces(
    control_points: Float[Array, "nu nv d"],
    knots_u: Float[Array, " knots_u"],
    knots_v: Float[Array, " knots_v"],
) -> Pieces:
    """All polynomial pieces of a surface; the orders follow from the shapes."""
    nu, nv, d = control_points.shape
    order_u, order_v = knots_u.shape[0] - nu, knots_v.shape[0] - nv
    poly_u, poly_v = span_polynomials(knots_u, order_u), span_polynomials(knots_v, order_v)
    cells_u, cells_v = nu - order_u + 1, nv - order_v + 1
    # One direction at a time, as sums of shifted slices: no gather, and XLA fuses the lot.
    rows: Any = sum(
        poly_u[:, r, :, None, None] * control_points[r : r + cells_u, None] for r in range(order_u)
    )
    both: Any = sum(
        rows[:, :, r : r + cells_v, :, None] * poly_v[None, None, :, r, None, :] for r in range(order_v)
    )
    ordered = both.transpose(0, 2, 3, 1, 4)
    coefficients = ordered.reshape(cells_u * cells_v, d, order_u, order_v)
    return Pieces(coefficients, make_axis(knots_u, order_u), make_axis(knots_v, order_v))


def as_surface_arrays(spline: Any) -> tuple[Array, Array, Array]:
    """Control points and knots of a surface; of a curve, as a surface of order 1 in v on [0, 1]."""
    points = spline.control_points
    if points.ndim == 3:
        return points, spline.knots_u, spline.knots_v
    return points[:, None, :], spline.knots, jnp.asarray([0.0, 1.0], spline.knots.dtype)
