"""Feet that one evaluation takes all the way, and the proof that they have arrived.

Close to a foot the second-order Taylor polynomial of the surface stands in for the surface,

    R^ = R + R_s ds + R_t dt + (R_ss ds^2 + 2 R_st ds dt + R_tt dt^2) / 2,

and its foot is found without evaluating anything again. With M a bound on the third derivatives in the cell
and L = |ds| + |dt|, the surface is within M L^3 / 6 of R^ there and its tangents are within M L^2 / 2 of
those of R^, which bounds the tangential part of the true residual.
"""

import math
from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._cells import Jet, in_line
from jaxfit._closest._box import RowBox, Sides
from jaxfit._closest._feet import INSIDE
from jaxfit._closest._follow import pins_in_line, rowwise
from jaxfit._closest._steps import Forms, dot, measure
from jaxfit._splines._pieces import Pieces

LONGEST_GUESS = 1.0  # in local coordinates; farther off than that, the polynomial says nothing
ROUNDING = 64.0  # of a squared distance, in units of the last place


def third_derivatives(pieces: Pieces) -> Float[Array, " cells"]:
    """Of every cell, a bound on the lengths of all third derivatives, in its local coordinates."""
    coefficients = jnp.asarray(pieces.coefficients)
    lengths = jnp.sqrt(sum(coefficients[:, k] ** 2 for k in range(coefficients.shape[1])))
    order_u, order_v = pieces.order
    bound = jnp.zeros_like(lengths[:, 0, 0])
    for i in range(4):
        terms = [(a, b) for a in range(i, order_u) for b in range(3 - i, order_v)]
        # Written out, for a reduction of so few numbers takes longer than the sum.
        sums = (float(math.perm(a, i) * math.perm(b, 3 - i)) * lengths[:, a, b] for a, b in terms)
        bound = jnp.maximum(bound, sum(sums, jnp.zeros_like(bound)))
    return bound


def arrive(
    e: Float[Array, "d slots"],
    jet: Jet,
    u: Float[Array, " slots"],
    v: Float[Array, " slots"],
    box: RowBox,
    third: Float[Array, "rows 1"],
    tolerance: Float[Array, ""],
    creased: bool,
) -> tuple[
    Float[Array, " slots"],
    Float[Array, " slots"],
    Float[Array, "d slots"],
    Bool[Array, " slots"],
    Bool[Array, " slots"],
]:
    """Parameters of the feet, their residuals, which of them are certain, and which are in their row's cell.

    A foot that is not certain is left where the polynomial has it, to be looked at again there. The slots of
    all rows are in one line; `box` and `third`, the bound on the third derivatives, have one entry a row.
    """
    always = tolerance < jnp.inf
    first = materialise(always, lambda e, jet: measure(e, jet, False), e, jet)
    pinned_s, pinned_t, _ = pins_in_line(always, first, u, v, box, tolerance)
    ds, dt = materialise(always, _solve, first, first.gradient_s, first.gradient_t, pinned_s, pinned_t)
    # The same matrix once more, on the polynomial: convergence of order three for one evaluation.
    gs, gt = materialise(always, _gradient, e, jet, ds, dt)
    ds, dt = materialise(always, _solve, first, gs, gt, pinned_s, pinned_t, ds, dt)
    e = materialise(always, _residual, e, jet, ds, dt)

    def landed(u: Array, v: Array, ds: Array, dt: Array) -> tuple[Array, Array, Array, Array, Array]:
        return _landed(u, v, ds, dt, box.along_rows(), third)

    landing = materialise(always, landed, *rowwise((u, v, ds, dt), box))
    next_u, next_v, turned, inside, stays = (in_line(x) for x in landing)
    proven = materialise(always, _is_proven, first, e, jet, ds, dt, pinned_s, pinned_t, turned, tolerance)
    if creased:  # what is held at a bound may have to go on behind it
        proven &= ~(pinned_s | pinned_t)
    return next_u, next_v, e, inside & proven, stays


def _gradient(e: Array, jet: Jet, ds: Array, dt: Array) -> tuple[Array, Array]:
    """Products of the polynomial's tangents with its residual after a step."""
    e = _residual(e, jet, ds, dt)
    tangent_s, tangent_t = _tangents(jet, ds, dt)
    return dot(e, tangent_s), dot(e, tangent_t)


def _solve(
    first: Forms, gs: Array, gt: Array, pinned_s: Array, pinned_t: Array, ds: Any = 0.0, dt: Any = 0.0
) -> tuple[Array, Array]:
    """A Newton step on from (ds, dt), with the Hessian at the start; NaN where this is not definite."""
    a, b, c = first.E - first.e_ss, first.F - first.e_st, first.G - first.e_tt
    gs, gt = jnp.where(pinned_s, 0.0, gs), jnp.where(pinned_t, 0.0, gt)
    a, c = jnp.where(pinned_s, 1.0, a), jnp.where(pinned_t, 1.0, c)
    b = jnp.where(pinned_s | pinned_t, 0.0, b)
    determinant = a * c - b * b
    inverse = jnp.where((a > 0) & (determinant > 0), 1.0, jnp.nan) / determinant
    return ds + (c * gs - b * gt) * inverse, dt + (a * gt - b * gs) * inverse


def _residual(e: Array, jet: Jet, ds: Array, dt: Array) -> Array:
    """From the polynomial to the point."""
    ds, dt = ds[None], dt[None]
    bent = ds * ds * jet.ss + 2.0 * ds * dt * jet.st + dt * dt * jet.tt
    return e - ds * jet.s - dt * jet.t - 0.5 * bent


def _tangents(jet: Jet, ds: Array, dt: Array) -> tuple[Array, Array]:
    ds, dt = ds[None], dt[None]
    return jet.s + ds * jet.ss + dt * jet.st, jet.t + ds * jet.st + dt * jet.tt


def _landed(
    u: Array, v: Array, ds: Array, dt: Array, box: Sides, third: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """The new parameters, how far the tangents are from the polynomial's, whether it holds all the way, and
    whether the end is in the cell.
    """
    next_u, next_v = u + ds * box.half_u, v + dt * box.half_v
    length = jnp.abs(ds) + jnp.abs(dt)
    # All the way: the bound on the third derivatives holds in the cell.
    begins, stays = (_in_cell(*box.local(*x)) for x in ((u, v), (next_u, next_v)))
    inside = begins & stays
    inside &= (next_u >= box.low_u) & (next_u <= box.high_u)
    inside &= (next_v >= box.low_v) & (next_v <= box.high_v)
    near = length < LONGEST_GUESS  # not where it is not a number
    next_u = jnp.where(near, jnp.clip(next_u, box.low_u, box.high_u), u)
    next_v = jnp.where(near, jnp.clip(next_v, box.low_v, box.high_v), v)
    return next_u, next_v, 0.5 * third * length * length, inside, stays


def _in_cell(s: Array, t: Array) -> Array:
    return (jnp.abs(s) <= INSIDE) & (jnp.abs(t) <= INSIDE)


def _is_proven(
    first: Forms,
    e: Array,
    jet: Jet,
    ds: Array,
    dt: Array,
    pinned_s: Array,
    pinned_t: Array,
    turned: Array,
    tolerance: Array,
) -> Array:
    """Whether the true residual's tangential part is below the tolerance in each free direction.

    Its product with a tangent is at most |e . R^_s| + |e| M L^2 / 2 + (M L^3 / 6) (|R^_s| + M L^2 / 2).
    """
    shifted = turned * (jnp.abs(ds) + jnp.abs(dt)) * (1.0 / 3.0)
    square = dot(e, e)
    far = jnp.sqrt(square)
    eps = ROUNDING * float(jnp.finfo(ds.dtype).eps)
    proven = square <= first.f * (1.0 + eps) + tolerance**2
    gradients = (pinned_s, first.gradient_s), (pinned_t, first.gradient_t)
    for tangent, (pinned, gradient) in zip(_tangents(jet, ds, dt), gradients, strict=True):
        g, size = dot(e, tangent), jnp.sqrt(dot(tangent, tangent))
        doubt = far * turned + shifted * (size + turned)
        settled = jnp.abs(g) + doubt <= tolerance * (size - turned)
        # What is held at a bound goes on being held there; along so short a tangent nothing moves.
        held = ((g * gradient > 0) & (jnp.abs(g) >= doubt)) | (size + turned <= tolerance)
        proven &= settled | (pinned & held)
    return proven
