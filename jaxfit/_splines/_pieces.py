"""A spline as polynomials, one per cell: the form that fast evaluation and all fits use.

A *cell* is a knot-span rectangle. With K - 1 and L - 1 the degrees, the surface on a cell is

    R(u, v) = sum_ab C[cell, :, a, b] s^a t^b,      s, t in [-1, 1],

with local coordinates s = (u - centre_u) / half_u and likewise t. On [-1, 1], unlike [0, 1], the
monomials of low degree are well conditioned, so little is lost against the recursion. A curve is the
same with a single cell and order 1 in v.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._checks import is_concrete
from jaxfit._remembered import remembered
from jaxfit._splines._lookup import last_not_above, windows
from jaxfit._varying import as_varying

Numbers = Array | np.ndarray
LAST_KNOTS = 32  # prepared knot vectors that are remembered


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
        ends = np.asarray(self.ends) if is_concrete(self.ends) else self.ends
        return lax.clamp(ends[0], last_not_above(self.breaks, jnp.asarray(u)), ends[1])


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
    if is_concrete(knots):
        return _axis_on_host(np.asarray(knots), order, simple)
    return _axis(knots, order, simple)


def _axis(knots: Float[Numbers, " knots"], order: int, simple: bool) -> Axis:
    concrete = is_concrete(knots)
    xp: Any = np if concrete else jnp
    dtype, knots = knots.dtype, np.asarray(knots, np.float64) if concrete else knots
    cells = knots.shape[0] - 2 * order + 1
    breaks = knots[order - 1 : order + cells]
    low, high = breaks[:-1], breaks[1:]
    width = high - low
    filled = width > 0
    centre, half = 0.5 * (low + high), _where(filled, 0.5 * width, 1.0)
    number = np.arange(cells, dtype=np.int32)
    # The nearest filled cell from here on, to the left and to the right.
    left = _highest_so_far(_where(filled, number, -1))
    right = _lowest_from_here(_where(filled, number, cells))
    ends = xp.concatenate([right[:1], left[-1:]])
    first, last = (xp.broadcast_to(end, (cells,)) for end in ends)
    before, after, creased = number, number, False
    if not simple or order == 2:
        # A knot of multiplicity order - 1 lies as many knots away from the end of a filled span as fit.
        reach = max(order - 2, 0)
        starts = filled & (knots[order - 1 - reach : order - 1 - reach + cells] >= low)
        stops = filled & (knots[order + reach : order + reach + cells] <= high)
        creased = bool(np.any(starts & (low > breaks[0]))) if concrete else True
        first = xp.maximum(_highest_so_far(_where(starts, number, 0)), first)
        last = xp.minimum(_lowest_from_here(_where(stops, number, cells - 1)), last)
        # The filled cell on the other side of a crease; empty spans may lie between.
        before = _where(first > first[:1], windows(left, xp.maximum(first - 1, 0), 1)[0], number)
        after = _where(last < last[-1:], windows(right, xp.minimum(last + 1, cells - 1), 1)[0], number)
    # Empty spans are points: as polynomials they would go on beyond the knots.
    wanted = filled[:, None, None] | (np.arange(order) == 0)[None, None]
    polynomials = span_polynomials(knots, centre, half, order) * wanted
    bounds = xp.stack([windows(low, first, 1)[0], windows(high, last, 1)[0], centre, half])
    return Axis(
        breaks=breaks.astype(dtype),
        bounds=bounds.astype(dtype),
        first=first,
        last=last,
        ends=ends,
        before=before,
        after=after,
        polynomials=polynomials.astype(dtype),
        creased=creased,
    )


@remembered(LAST_KNOTS)
def _axis_on_host(knots: Float[np.ndarray, " knots"], order: int, simple: bool) -> Axis:
    axis = _axis(knots, order, simple)
    for array in jax.tree.leaves(axis):
        array.flags.writeable = False  # for it is shared
    return axis


def _where(condition: Any, x: Any, y: float | Any) -> Any:
    """`x` where the condition holds, else `y`; either may be a number of the other's type."""
    if is_concrete(condition, x, y):
        return np.where(condition, x, y).astype(x.dtype)
    y = y if np.ndim(y) else np.full(condition.shape, y, x.dtype)
    return lax.select(condition, jnp.asarray(x), jnp.asarray(y))


def _highest_so_far(x: Any) -> Any:
    return np.maximum.accumulate(x) if is_concrete(x) else lax.cummax(x)


def _lowest_from_here(x: Any) -> Any:
    return np.minimum.accumulate(x[::-1])[::-1] if is_concrete(x) else lax.cummin(x, reverse=True)


def span_polynomials(knots: Any, centre: Any, half: Any, order: int) -> Float[Numbers, "spans K K"]:
    """Non-zero basis functions of every span as polynomials, M[span, r, a] of s^a, s in [-1, 1].

    The Cox-de Boor recursion, (2)-(3) in the paper, carried out on coefficients for all r and spans at once:
    each of its factors is a polynomial of degree one in s. What empty spans give has no meaning.
    """
    concrete, spans = is_concrete(knots, centre, half), centre.shape[0]
    basis: Any = np.zeros((order, order, spans), knots.dtype)  # r, a, span
    basis[0, 0] = 1.0
    if order > 1:
        # Knots in the coordinate s of the span, whose own ends are -1 and 1 also where it is empty.
        local = ((windows(knots, np.arange(spans), 2 * order) - centre[None]) / half[None])[:, None]
        local = np.asarray(local) if concrete else local
        xp: Any = np if concrete else jnp
        right = xp.maximum(local[order:], 1.0)
        # Row r of step d are the knots that begin the supports of degree d; the last step comes first.
        left = xp.minimum(windows(local, np.arange(1, order + 1), order - 1), -1.0)
        if concrete:
            for each in left[::-1]:
                basis = _raised_polynomials(basis, each, right)
        else:
            basis = _all_raised(jnp.asarray(basis), left, right)
    return basis.transpose(2, 0, 1)


@jax.jit  # else a batch would compile the loop anew each time
def _all_raised(basis: Any, left: Any, right: Any) -> Any:
    """The polynomials of the highest degree, from those of degree 0."""

    def step(basis: Any, left: Any) -> tuple[Any, None]:
        return _raised_polynomials(basis, left, right), None

    return lax.scan(step, as_varying(basis, left), left, reverse=True)[0]


def _raised_polynomials(basis: Any, left: Any, right: Any) -> Any:
    """The polynomials of one degree more, for all supports, which begin at `left` and end at `right`."""
    share = basis / (right - left)
    shifted = _shifted(share, 1)
    return right * share - shifted + _shifted(shifted - left * share, 0)


def _shifted(x: Any, axis: int) -> Any:
    """The entries of `x` one place on, behind a zero; the last is dropped."""
    if is_concrete(x):
        moved = np.zeros_like(x)
        moved.swapaxes(0, axis)[1:] = x.swapaxes(0, axis)[:-1]
        return moved
    return lax.pad(x, np.zeros((), x.dtype), [(int(i == axis), -int(i == axis), 0) for i in range(x.ndim)])


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
    poly_u, poly_v = axis_u.polynomials, axis_v.polynomials
    if concrete := is_concrete(control_points, axis_u, axis_v):
        poly_u, poly_v, control_points = (np.asarray(x) for x in (poly_u, poly_v, control_points))
    (cells_u, order_u, _), (cells_v, order_v, _) = poly_u.shape, poly_v.shape
    around = windows(control_points, np.arange(cells_u), order_u)
    exact: Any = {} if concrete else {"precision": lax.Precision.HIGHEST}
    rows = (np if concrete else jnp).einsum("ira,rimd->iamd", poly_u, around, **exact)
    # Along v a sum of shifted slices, which XLA fuses: a product of matrices takes twice as long there.
    along_v = poly_v.transpose(1, 0, 2)[:, None, None, :, None, :]
    both: Any = sum(rows[:, :, r : r + cells_v, :, None] * along_v[r] for r in range(order_v))
    coefficients = both.transpose(0, 2, 3, 1, 4).reshape(cells_u * cells_v, -1, order_u, order_v)
    return Pieces(coefficients, axis_u, axis_v)


def as_surface_arrays(spline: Any) -> tuple[Array, Array, Array]:
    """Control points and knots of a surface; of a curve, as a surface of order 1 in v on [0, 1]."""
    points = spline.control_points
    if points.ndim == 3:
        return points, spline.knots_u, spline.knots_v
    return points[:, None, :], spline.knots, jnp.asarray([0.0, 1.0], spline.knots.dtype)
