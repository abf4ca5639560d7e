r"""G, the residual of a method's `StationarityCondition`, as a differentiable function of net and data.

The feet are eliminated: they move with the net and with the points by the implicit derivative of a closest
point. Points are laid out in rows of one cell at the feet of one net, and the function is exact there, with
its first derivatives; a move of a foot is a number that is zero and has a derivative.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._cells import (
    Jet,
    Rows,
    cells_to_net,
    evaluate_jet,
    powers,
    row_coefficients,
    row_moments,
    row_width,
    rows_of,
)
from jaxfit._cells import local_coordinates as local_coordinates_of
from jaxfit._closest import dot
from jaxfit._closest._implicit import foot_moves
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._problem import Problem
from jaxfit._fit._stationarity_condition import StationarityCondition
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._splines._pieces import Pieces
from jaxfit._unrolling import root_with_slope

ROUNDING = 8.0  # rounding units of the sums of G: what is left of them counts as zero


class FeetInRows(eqx.Module):
    """Where the points are in rows of one cell, and their feet there, in both coordinates."""

    rows: Rows
    u: Float[Array, "rows width"]
    v: Float[Array, "rows width"]
    s: Float[Array, "rows width"]
    t: Float[Array, "rows width"]


class StationarityResidual(eqx.Module):
    """G at one net, per control point; what it is small or large against; and where the feet are.

    `terms` is the sum of the norms of the terms of G, and `rounding` what G cannot fall below.
    """

    value: Float[Array, "nu nv d"]
    terms: Float[Array, ""]
    rounding: Float[Array, ""]
    u: Float[Array, "rows width"]
    v: Float[Array, "rows width"]
    error: Float[Array, "rows width"]


def feet_in_rows(surface: WorkingSurface, problem: Problem, u: Array, v: Array) -> FeetInRows:
    """All real points, those of weight 0 too, for the derivative with respect to their weight."""
    pieces = jax.tree.map(jnp.asarray, surface.pieces)
    width = row_width(u.shape[0], pieces.cells)
    return feet_at(surface, rows_of(pieces, u, v, width, ~jnp.asarray(problem.real)), u, v)


def feet_at(surface: WorkingSurface, rows: Rows, u: Array, v: Array) -> FeetInRows:
    """With points in known rows, near whose cells the feet (u, v) are."""
    pieces = jax.tree.map(jnp.asarray, surface.pieces)
    u, v = rows.spread(jnp.stack([u, v]))
    s, t = local_coordinates_of(pieces, rows.cell[:, None], u, v)
    return FeetInRows(rows, u, v, s, t)


def in_rows(problem: Problem, rows: Rows) -> Problem:
    """The problem with a slot of the rows for each point; empty slots have weight 0."""
    spread = rows.spread(jnp.concatenate([problem.target, problem.weight[None]]))
    filled = rows.filled.reshape(-1)
    flat = spread.reshape(spread.shape[0], -1)
    parts = flat[:-1], jnp.where(filled, flat[-1], 0.0), filled
    return eqx.tree_at(lambda p: (p.target, p.weight, p.real), problem, parts)


def stationarity_residual(
    method: AbstractIterativeMethod,
    state: Any,
    surface: WorkingSurface,
    problem: Problem,
    feet: FeetInRows,
    free: Bool[Array, "nu nv"],
    still: Float[Array, "nu nv d"],
) -> StationarityResidual:
    """G at the net of `surface`, whose feet are `feet`. Control points not `free` should be as in `still`.

    Where the method finds feet, they follow the net and the points. Otherwise `feet` are given.
    """
    here, pieces = in_rows(problem, feet.rows), surface.pieces
    pieces = jax.tree.map(jnp.asarray, pieces)
    d, shape = problem.target.shape[0], feet.s.shape
    target, (order_u, order_v) = here.target.reshape(d, *shape), pieces.order
    s, t = jax.lax.stop_gradient((feet.s, feet.t))
    monomials = _monomials(s, t, order_u, order_v)
    jet = _following(row_coefficients(pieces, feet.rows), s, t, monomials)
    if method.finds_feet:
        ds, dt = foot_moves(pieces, (feet.u, feet.v), target, jet, problem.diagonal)
    else:
        ds, dt = feet.s - s, feet.t - t
    along_s, along_t = jax.lax.stop_gradient((jet.s, jet.t))
    residual = jet.value - target + _times(along_s, ds) + _times(along_t, dt)
    error = _length(residual)
    condition = method.stationarity(here, surface, state, error.reshape(-1))
    weight = condition.weight.reshape(shape)
    pulls = weight[None] * residual
    fixed = jax.lax.stop_gradient(pulls)
    summands = jnp.concatenate([pulls, _times(fixed, ds), _times(fixed, dt)], axis=2)
    moments = jnp.stack([_summed(x, monomials) for x in summands], axis=2)
    data = _on_net(pieces, feet.rows, moments.reshape(-1, order_u, order_v * d))
    smooth = _half_gradient(condition, surface.control_points)
    inside = free[:, :, None]
    value = jnp.where(inside, data + smooth, surface.control_points - still)
    terms, rounding = _sizes(pieces, feet, jet.value, pulls, weight, smooth, inside)
    wide = surface.axis_u, surface.axis_v
    half_u, half_v = (jnp.asarray(a.half) for a in wide)
    cell_u, cell_v = feet.rows.cell // wide[1].cells, feet.rows.cell % wide[1].cells
    u = jax.lax.stop_gradient(feet.u) + half_u[cell_u][:, None] * ds
    v = jax.lax.stop_gradient(feet.v) + half_v[cell_v][:, None] * dt
    return StationarityResidual(value, terms, rounding, u, v, error)


def _monomials(s: Array, t: Array, order_u: int, order_v: int) -> Float[Array, "rows _ _"]:
    """s^a t^b at each point of a row, then their derivatives in s, then in t: (a, b) by 3 times the width.

    With this matrix evaluation and sums over points are products that are as quick transposed.
    """
    powers_s, powers_t = (_powers_and_slopes(x, order) for x, order in ((s, order_u), (t, order_v)))
    pairs = (powers_s[0], powers_t[0]), (powers_s[1], powers_t[0]), (powers_s[0], powers_t[1])
    parts = [(x[:, :, None] * y[:, None]).reshape(len(s), -1, s.shape[1]) for x, y in pairs]
    return jnp.concatenate(parts, axis=2)


def _powers_and_slopes(s: Float[Array, "rows width"], order: int) -> tuple[Array, Array]:
    """The powers of s below `order`, and their derivatives, (rows, order, width) each."""
    rising = jnp.moveaxis(powers(s, order), 0, 1)
    degree = jnp.arange(1, order, dtype=s.dtype)[None, :, None]
    return rising, jnp.pad(degree * rising[:, :-1], ((0, 0), (1, 0), (0, 0)))


def _evaluated(x: Float[Array, "rows p"], monomials: Array) -> Float[Array, "rows _"]:
    """Polynomials with the coefficients x, and their derivatives, at the points of each row."""
    return jnp.einsum("rp,rpw->rw", x, monomials, precision=jax.lax.Precision.HIGHEST)


def _summed(x: Float[Array, "rows _"], monomials: Array) -> Float[Array, "rows p"]:
    """The transpose: sums over each row of the monomials times x."""
    return jnp.einsum("rw,rpw->rp", x, monomials, precision=jax.lax.Precision.HIGHEST)


def _following(coefficients: Float[Array, "rows d K L"], s: Array, t: Array, monomials: Array) -> Jet:
    """The jet at known places; value and first derivatives follow the coefficients."""
    rows, d = coefficients.shape[:2]
    fixed = jax.lax.stop_gradient(coefficients)
    jet = evaluate_jet(fixed, s, t)
    change = (coefficients - fixed).reshape(rows, d, -1)
    # A product for each coordinate: one for all, transposed, takes several times as long.
    changes = jnp.stack([_evaluated(change[:, k], monomials) for k in range(d)])
    firsts = zip((jet.value, jet.s, jet.t), jnp.split(changes, 3, axis=2), strict=True)
    return jet._replace(**dict(zip(("value", "s", "t"), (x + dx for x, dx in firsts), strict=True)))


def _times(vectors: Float[Array, "d rows width"], x: Float[Array, "rows width"]) -> Array:
    """Vectors times numbers; the transpose is written out, too, which takes half as long as a reduction."""
    return jnp.stack([vector * x for vector in vectors])


def _half_gradient(condition: StationarityCondition, net: Array) -> Array:
    penalty = condition.penalty
    return jnp.zeros_like(net) if penalty is None else 0.5 * jax.grad(penalty.energy)(net)


def _on_net(pieces: Pieces, rows: Rows, moments: Array) -> Array:
    total = jnp.zeros((pieces.cells, *moments.shape[1:]), moments.dtype).at[rows.cell].add(moments)
    return cells_to_net(total, pieces.axis_u.polynomials, pieces.axis_v.polynomials)


def _sizes(
    pieces: Pieces, feet: FeetInRows, value: Array, pulls: Array, weight: Array, smooth: Array, inside: Array
) -> tuple[Array, Array]:
    """The norms of sum_k w_k N_i N_j |r_k| plus that of the smoothing term, and what rounding leaves."""
    values = jnp.stack([_length(pulls), jnp.abs(weight) * _length(value)])
    values, s, t, smooth = jax.lax.stop_gradient((values, feet.s, feet.t, smooth))
    sums = _on_net(pieces, feet.rows, row_moments(s, t, values, *pieces.order))
    sums = jnp.where(inside, sums, 0.0)
    data, places = jnp.sqrt(jnp.sum(sums**2, axis=(0, 1)))
    terms = data + jnp.sqrt(jnp.sum(jnp.where(inside, smooth, 0.0) ** 2))
    return terms, ROUNDING * jnp.finfo(value.dtype).eps * places


def _length(x: Float[Array, "d rows width"]) -> Float[Array, "rows width"]:
    """Lengths, with the derivative 0 where they vanish."""
    return root_with_slope(dot(x, x))
