"""Foot points from one evaluation of the surface, with a bound that certifies them.

Close to a foot the surface is replaced by its second-order Taylor polynomial,

    R^ = R + R_s ds + R_t dt + (R_ss ds^2 + 2 R_st ds dt + R_tt dt^2) / 2,

whose foot is found without another evaluation of the surface. With M a bound on the third derivatives in the
cell and L = |ds| + |dt|, the surface is within M L^3 / 6 of R^ there and its tangents are within M L^2 / 2 of
those of R^. This bounds the tangential part of the true residual.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._closest._bounds import Bounds
from jaxfit._closest._forms import Expansion, Forms, both, inner, product, total
from jaxfit._splines._pieces import Pieces

INSIDE = 1.0 + 1e-6  # in units of a cell's half width: where its polynomial is the surface
LONGEST_TAYLOR_STEP = 1.0  # in local coordinates; farther away the polynomial is no approximation
ROUNDING = 64.0  # of a squared distance, in units of the last place


class Prediction(NamedTuple):
    """Where a step ends, the residual predicted there, its square, and whether that is certain."""

    end: Float[Array, "2 1 slots"]
    e: Float[Array, "1 d slots"]
    f: Float[Array, "1 1 slots"]
    certain: Bool[Array, "1 1 slots"]


class _Inverse(NamedTuple):
    """The inverse of the Hessian on the free coordinates; not a number where this is not definite."""

    adjugate: Float[Array, "2 1 slots"]
    mixed: Float[Array, "1 1 slots"]
    scale: Float[Array, "1 1 slots"]
    free: Float[Array, "2 1 slots"]  # 1, or 0 for coordinates that are held at a bound

    def __call__(self, gradient: Float[Array, "2 1 slots"]) -> Float[Array, "2 1 slots"]:
        g = gradient * self.free
        return (self.adjugate * g - self.mixed * lax.rev(g, (0,))) * self.scale


def third_derivatives(pieces: Pieces) -> Float[Array, " cells"]:
    """Of every cell, a bound on the lengths of all third derivatives, in its local coordinates."""
    coefficients = jnp.asarray(pieces.coefficients)
    lengths = jnp.sqrt((coefficients * coefficients).sum(1)).reshape(coefficients.shape[0], -1)
    order_u, order_v = pieces.order

    def factors(i: int) -> list[float]:
        """What each coefficient is multiplied by in the derivative of order (i, 3 - i)."""
        pairs = [(a, b) for a in range(order_u) for b in range(order_v)]
        return [float(math.perm(a, i) * math.perm(b, 3 - i)) for a, b in pairs]

    sums = lax.dot(lengths, jnp.asarray([factors(i) for i in range(4)], lengths.dtype).T, precision="highest")
    return sums.max(1)


def certified_step(
    always: Bool[Array, ""],
    at: Expansion,
    forms: Forms,
    x: Float[Array, "2 1 slots"],
    active: Bool[Array, "2 1 slots"],
    bounds: Bounds,
    third: Float[Array, "1 1 slots"],
    tolerance: Float[Array, ""],
) -> tuple[Prediction, Bool[Array, "1 1 slots"]]:
    """The foot on the Taylor polynomial by two Newton steps, and whether it makes a good next trial.

    It is certain if the bound proves the true residual's tangential part to be within the tolerance.
    """

    def solve(at: Expansion, forms: Forms, active: Array) -> tuple[Array, Array, Array]:
        # A second step with the same matrix, on the polynomial: order three from one evaluation.
        inverse = _inverse(forms, active)
        step = inverse(forms.gradient)
        e, tangents = _taylor(at, step)
        second = inverse(inner(e, tangents))
        # Where the second takes back the first, both together lead nowhere although there is no foot.
        return step + second, total((0.5 * step + second) * forms.gradient), inverse.free

    step, progress, free = materialise(always, solve, at, forms, active)
    e, tangents = materialise(always, _taylor, at, step)

    def certify(
        e: Array, tangents: Array, step: Array, progress: Array, free: Array, forms: Forms, x: Array
    ) -> tuple:
        f, length = inner(e, e), total(jnp.abs(step))
        end = x + step * bounds.half
        # A coupled step that is cut off at a bound may lead away from the foot.
        nearest = lax.clamp(bounds.low, end, bounds.high)
        allowed = nearest == end
        within = allowed & _in_cell(bounds, x) & _in_cell(bounds, end)
        slopes, sizes = inner(e, tangents), jnp.sqrt(inner(tangents, tangents))
        turned = 0.5 * third * length * length
        # The product of the true residual with a tangent is at most
        # |e . R^_s| + |e| M L^2 / 2 + (M L^3 / 6) (|R^_s| + M L^2 / 2).
        bound = jnp.sqrt(f) * turned + (1.0 / 3.0) * turned * length * (sizes + turned)
        proven = jnp.abs(slopes) + bound <= tolerance * (sizes - turned)
        # A coordinate at an active bound must stay active there, or its tangent be too short to matter.
        held = (slopes * forms.gradient > 0) & (jnp.abs(slopes) >= bound)
        proven |= (free == 0) & (held | (sizes + turned <= tolerance))
        eps = ROUNDING * float(jnp.finfo(f.dtype).eps)
        nearer = f <= forms.f * (1.0 + eps) + tolerance**2
        certain = both(within & proven) & nearer
        good = nearer & (progress > 0) & both(allowed) & (length < LONGEST_TAYLOR_STEP)
        return Prediction(nearest, e, f, certain), good

    return materialise(always, certify, e, tangents, step, progress, free, forms, x)


def _inverse(forms: Forms, active: Array) -> _Inverse:
    diagonal, mixed = forms.hessian
    free = (~active).astype(diagonal.dtype)
    diagonal = lax.select(active, jnp.ones_like(diagonal), diagonal)
    mixed = mixed * product(free)
    determinant = product(diagonal) - mixed * mixed
    definite = (diagonal[:1] > 0) & (determinant > 0)
    scale = jnp.where(definite, 1.0, jnp.nan) / determinant
    return _Inverse(lax.rev(diagonal, (0,)), mixed, scale, free)


def _taylor(at: Expansion, step: Array) -> tuple[Array, Array]:
    """The residual and the tangents of the polynomial after a step."""
    turn = step * at.second[:2] + lax.rev(step, (0,)) * at.second[2:]
    e = at.e - total(step * (at.first + 0.5 * turn))
    return e, at.first + turn


def _in_cell(bounds: Bounds, x: Array) -> Array:
    return jnp.abs(bounds.local(x)) <= INSIDE


def linearised_step(
    at: Expansion,
    forms: Forms,
    x: Float[Array, "2 1 slots"],
    step: Float[Array, "2 1 slots"],
    bounds: Bounds,
) -> Prediction:
    r"""Where a step ends, and the residual there to first order, $e - R_u \delta u - R_v \delta v$.

    A step that would lengthen it is cut to where it is shortest.
    """
    along = total(forms.gradient * step)
    length2 = total(forms.metric * step * step) + 2.0 * forms.metric_mixed * product(step)
    shortest = jnp.maximum(along, 0.0) / jnp.where(length2 > 0, length2, 1.0)
    step = jnp.where(2.0 * along >= length2, step, shortest * step)
    e = at.e - total(step * at.first)
    f = inner(e, e)
    return Prediction(bounds.end_of_step(x, step), e, f, jnp.ones_like(f, bool))
