"""A spline as polynomials, one per cell: what every fast evaluation and every fit stands on.

A *cell* is a knot-span rectangle. With K - 1 and L - 1 the degrees, the surface on a cell is

    R(u, v) = sum_ab C[cell, :, a, b] s^a t^b,      s, t in [-1, 1],

with local coordinates s = (u - centre_u) / half_u and likewise t. On [-1, 1], unlike [0, 1], the
monomials of low degree are well conditioned, so little is lost against the recursion. A curve is the
same with a single cell and order 1 in v.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._barrier import materialise
from jaxfit._checks import is_concrete

Numbers = Array | np.ndarray

UNROLLED = 30  # terms of a sum


class Axis(eqx.Module):
    """One direction of the cells: all that depends on the knots and not on the net.

    A crease is a knot of multiplicity order - 1 or more, where the tangent may jump. `first` and `last` are
    the cells at the ends of the smooth stretch, without creases inside, that a cell lies in; `before` and
    `after` are the cells across the creases on either side (the cell itself at the ends of the domain).
    `ends` are the first and the last cell of positive width. `bounds` holds, for every cell, both ends of
    its stretch, its own middle and half its width (1 for an empty span, which no parameter falls into).
    `polynomials` are the basis functions, `span_polynomials`.

    Whether there are creases is known before tracing where the knots are.
    """

    breaks: Float[Numbers, " breaks"]
    bounds: Float[Numbers, "4 cells"]
    first: Int[Numbers, " cells"]
    last: Int[Numbers, " cells"]
    ends: Int[Numbers, "2"]
    before: Int[Numbers, " cells"]
    after: Int[Numbers, " cells"]
    polynomials: Float[Numbers, "cells K K"]
    creased: bool = eqx.field(static=True)

    @property
    def cells(self) -> int:
        """Number of knot spans, empty ones included (so that it depends on shapes only)."""
        return self.bounds.shape[1]

    @property
    def used(self) -> Any:
        """How many control points have influence: all but those behind surplus knots at the right end."""
        return self.ends[1] + self.polynomials.shape[1]

    @property
    def low(self) -> Float[Numbers, " cells"]:
        """Lower end of every cell's stretch."""
        return self.bounds[0]

    @property
    def high(self) -> Float[Numbers, " cells"]:
        """Upper end of every cell's stretch."""
        return self.bounds[1]

    @property
    def centre(self) -> Float[Numbers, " cells"]:
        """Middle of every span."""
        return self.bounds[2]

    @property
    def half(self) -> Float[Numbers, " cells"]:
        """Half the width of every span."""
        return self.bounds[3]

    def locate(self, u: Any) -> Any:
        """Span with breaks[i] <= u < breaks[i+1]; the last non-empty one at the right end."""
        if is_concrete(self, u):
            number = np.searchsorted(np.asarray(self.breaks), np.asarray(u), side="right") - 1
            return np.clip(number, *np.asarray(self.ends)).astype(np.int32)
        inner = _last_not_above(jnp.asarray(self.breaks), jnp.asarray(u))
        return jnp.clip(inner, self.ends[0], self.ends[1]).astype(jnp.int32)


def _last_not_above(breaks: Float[Array, " breaks"], u: Float[Array, "..."]) -> Int[Array, "..."]:
    """The last i with breaks[i] <= u, by counting: every so many breaks, then those between.

    Two short sums without memory between compile and run faster than bisection. The first costs least, up to
    the length that is compiled without a loop.
    """
    count = breaks.shape[0]
    stride = min(math.isqrt(count), -(-count // UNROLLED))
    coarse = breaks[::stride].reshape((-1,) + (1,) * u.ndim) <= u[None]
    first = jnp.maximum(jnp.sum(coarse, axis=0, dtype=jnp.int32) - 1, 0) * stride
    padded = jnp.concatenate([breaks, jnp.full(stride, jnp.inf, breaks.dtype)])
    return first + sum((padded[first + i] <= u).astype(jnp.int32) for i in range(1, stride))


class Pieces(eqx.Module):
    """Polynomial pieces of a surface, `coefficients[cell_u * cells_v + cell_v, coordinate, a, b]`."""

    coefficients: Float[Numbers, "cells d K L"]
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


def make_axis(knots: Float[Numbers, " knots"], order: int, simple: bool = False) -> Axis:
    """The spans of a knot vector's domain, with the smooth stretches they belong to.

    Concrete knots are dealt with by NumPy, so that nothing compiles. Of others it has to be assumed that they
    repeat, unless interior knots are known to be `simple`.
    """
    concrete = is_concrete(knots)
    xp: Any = np if concrete else jnp
    dtype, knots = knots.dtype, np.asarray(knots, np.float64) if concrete else knots
    breaks = knots[order - 1 : knots.shape[0] - order + 1]
    cells = breaks.shape[0] - 1
    number = xp.arange(cells)
    repeats = xp.sum(breaks[:, None] == knots[None, :], axis=1)
    at_end = (breaks <= breaks[0]) | (breaks >= breaks[-1])  # more often where there are surplus knots
    crease = (repeats >= max(order - 1, 1)) | at_end
    filled = breaks[1:] > breaks[:-1]
    # The nearest crease to the left and to the right; empty spans neither start nor end a stretch.
    first = _highest_so_far(xp.where(crease[:-1] & filled, number, 0))
    last = _lowest_from_here(xp.where(crease[1:] & filled, number, cells - 1))
    ends = xp.stack([xp.argmax(filled), cells - 1 - xp.argmax(filled[::-1])])
    # The filled cell on the other side of a crease; empty spans may lie between.
    left = _highest_so_far(xp.where(filled, number, -1))[xp.maximum(first - 1, 0)]
    right = _lowest_from_here(xp.where(filled, number, cells))[xp.minimum(last + 1, cells - 1)]
    before = xp.where(first > ends[0], left, number)
    after = xp.where(last < ends[1], right, number)
    centre, half = _middles(breaks)
    bounds = xp.stack([breaks[first], breaks[last + 1], centre, half])
    return Axis(
        breaks=breaks.astype(dtype),
        bounds=bounds.astype(dtype),
        first=first.astype(np.int32),
        last=last.astype(np.int32),
        ends=ends.astype(np.int32),
        before=before.astype(np.int32),
        after=after.astype(np.int32),
        polynomials=span_polynomials(knots, order).astype(dtype),
        creased=bool(np.any(crease & ~at_end)) if concrete else order == 2 or not simple,
    )


def _middles(breaks: Any) -> tuple[Any, Any]:
    """Centre and half width of every span."""
    xp: Any = np if is_concrete(breaks) else jnp
    width = breaks[1:] - breaks[:-1]
    return 0.5 * (breaks[1:] + breaks[:-1]), xp.where(width > 0, 0.5 * width, 1.0)


def _highest_so_far(x: Any) -> Any:
    return np.maximum.accumulate(x) if is_concrete(x) else lax.cummax(x)


def _lowest_from_here(x: Any) -> Any:
    return -_highest_so_far(-x[::-1])[::-1]


def span_polynomials(knots: Float[Numbers, " knots"], order: int) -> Float[Numbers, "spans K K"]:
    """Non-zero basis functions of every span as polynomials, M[span, r, a] of s^a, s in [-1, 1].

    The Cox-de Boor recursion, (2)-(3) in the paper, carried out on coefficients: each of its factors
    is a polynomial of degree one in s. Empty spans give finite values that nothing uses.
    """
    xp: Any = np if is_concrete(knots) else jnp
    centre, half = _middles(knots[order - 1 : knots.shape[0] - order + 1])
    spans = centre.shape[0]

    def knot(offset: int) -> Any:
        return knots[order - 1 + offset : order - 1 + offset + spans]

    one = xp.ones((spans, 1), knots.dtype)
    basis = [xp.concatenate([one, xp.zeros((spans, order - 1), knots.dtype)], axis=1)]
    for degree in range(1, order):
        raised = [xp.zeros((spans, order), knots.dtype)] * (degree + 1)
        for r in range(degree):
            left, right = knot(r + 1 - degree), knot(r + 1)
            width = right - left
            share = xp.where(width > 0, 1.0, 0.0) / xp.where(width > 0, width, 1.0)
            scaled = basis[r] * share[:, None]
            raised[r] = raised[r] + _times_linear(scaled, right - centre, -half)
            raised[r + 1] = raised[r + 1] + _times_linear(scaled, centre - left, half)
        basis = raised
    return xp.stack(basis, axis=1)


def _times_linear(p: Any, constant: Any, slope: Any) -> Any:
    """(constant + slope s) p(s), the highest coefficient of p being zero."""
    xp: Any = np if is_concrete(p, constant, slope) else jnp
    shifted = xp.concatenate([xp.zeros_like(p[:, :1]), p[:, :-1]], axis=1)
    return constant[:, None] * p + slope[:, None] * shifted


def make_pieces(
    control_points: Float[Numbers, "nu nv d"],
    knots_u: Float[Numbers, " knots_u"],
    knots_v: Float[Numbers, " knots_v"],
) -> Pieces:
    """All polynomial pieces of a surface; the orders follow from the shapes."""
    nu, nv, _ = control_points.shape
    axes = make_axis(knots_u, knots_u.shape[0] - nu), make_axis(knots_v, knots_v.shape[0] - nv)
    return pieces_on(control_points, *axes)


def pieces_on(control_points: Float[Numbers, "nu nv d"], axis_u: Axis, axis_v: Axis) -> Pieces:
    """The pieces of a surface, its knots having been dealt with before."""
    concrete = is_concrete(control_points, axis_u, axis_v)
    poly_u, poly_v = axis_u.polynomials, axis_v.polynomials
    if concrete:
        poly_u, poly_v, control_points = (np.asarray(x) for x in (poly_u, poly_v, control_points))
    (cells_u, order_u, _), (cells_v, order_v, _) = poly_u.shape, poly_v.shape

    # One direction at a time, as sums of shifted slices: no gather, and XLA fuses each.
    def along_u(poly_u: Any, control_points: Any) -> Any:
        return sum(
            poly_u[:, r, :, None, None] * control_points[r : r + cells_u, None] for r in range(order_u)
        )

    if concrete:
        rows = along_u(poly_u, control_points)
    else:
        rows = materialise(~(axis_u.breaks[0] > axis_u.breaks[-1]), along_u, poly_u, control_points)
    both: Any = sum(
        rows[:, :, r : r + cells_v, :, None] * poly_v[None, None, :, r, None, :] for r in range(order_v)
    )
    ordered = both.transpose(0, 2, 3, 1, 4)
    coefficients = ordered.reshape(cells_u * cells_v, -1, order_u, order_v)
    return Pieces(coefficients, axis_u, axis_v)


def as_surface_arrays(spline: Any) -> tuple[Array, Array, Array]:
    """Control points and knots of a surface; of a curve, as a surface of order 1 in v on [0, 1]."""
    points = spline.control_points
    if points.ndim == 3:
        return points, spline.knots_u, spline.knots_v
    return points[:, None, :], spline.knots, jnp.asarray([0.0, 1.0], spline.knots.dtype)
