"""Inner products of the residual and the derivatives at a foot, from which every step is computed.

Vectors are arrays (k, d, slots), numbers (k, 1, slots), with k = 2 for what belongs to both parameters. One
operation then serves both parameters, and nothing is reshaped.
"""

from functools import reduce
from operator import add

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._cells import evaluate_jet


class Expansion(eqx.Module):
    """The residual e = Q - R and the derivatives of the surface to second order, in local coordinates."""

    e: Float[Array, "1 d slots"]
    first: Float[Array, "2 d slots"]  # R_s, R_t
    second: Float[Array, "3 d slots"]  # R_ss, R_tt, R_st


class Forms(eqx.Module):
    """Inner products at the current feet."""

    f: Float[Array, "1 1 slots"]  # squared distance e . e
    gradient: Float[Array, "2 1 slots"]  # e . R_s and e . R_t: minus half the gradient of f
    metric: Float[Array, "2 1 slots"]  # E and G of the first fundamental form
    metric_mixed: Float[Array, "1 1 slots"]  # F of the first fundamental form
    second_form: Float[Array, "3 1 slots"]  # e . R_ss, e . R_tt, e . R_st: L, N and M times the distance
    # Christoffel symbols of the first kind, R_ss, R_tt and R_st times R_s and R_t, if a method needs them.
    christoffel: Float[Array, "2 3 1 slots"] | None = None

    @property
    def hessian(self) -> tuple[Float[Array, "2 1 slots"], Float[Array, "1 1 slots"]]:
        """Diagonal and off-diagonal entry of the Hessian of f / 2."""
        return self.metric - self.second_form[:2], self.metric_mixed - self.second_form[2:]


def expand(
    always: Bool[Array, ""],
    coefficients: Float[Array, "rows d K L"],
    local: Float[Array, "2 1 slots"],
    target: Float[Array, "1 d slots"],
) -> Expansion:
    """The surface around every slot's local coordinates; the slots of all rows lie in one line."""
    rows = local.reshape(2, coefficients.shape[0], -1)
    jet = materialise(always, lambda c, x: evaluate_jet(c, x[0], x[1]), coefficients, rows)
    value, s, t, ss, st, tt = (x.reshape(target.shape) for x in jet)
    return Expansion(target - value, jnp.concatenate([s, t]), jnp.concatenate([ss, tt, st]))


def inner_products(at: Expansion, christoffel: bool) -> Forms:
    """All inner products, the Christoffel symbols only if asked for."""
    e, first, second = at.e, at.first, at.second
    return Forms(
        f=inner(e, e),
        gradient=inner(e, first),
        metric=inner(first, first),
        metric_mixed=inner(first[:1], first[1:]),
        second_form=inner(e, second),
        christoffel=jnp.stack([inner(second, x) for x in (first[:1], first[1:])]) if christoffel else None,
    )


def product(x: Float[Array, "2 1 slots"]) -> Float[Array, "1 1 slots"]:
    """The product of both entries."""
    return x[:1] * x[1:]


def total(x: Float[Array, "k d slots"]) -> Float[Array, "1 d slots"]:
    """The sum of all entries."""
    return reduce(add, lax.split(x, (1,) * x.shape[0]))


def inner(x: Float[Array, "j d slots"], y: Float[Array, "k d slots"]) -> Float[Array, "_ 1 slots"]:
    """Inner products of vectors, written out: a reduction of so few numbers is slower, and not fused."""
    return reduce(add, lax.split(x * y, (1,) * x.shape[1], 1))


def either(x: Bool[Array, "2 1 slots"]) -> Bool[Array, "1 1 slots"]:
    """Whether one of both holds."""
    return x[:1] | x[1:]


def both(x: Bool[Array, "2 1 slots"]) -> Bool[Array, "1 1 slots"]:
    """Whether both hold."""
    return x[:1] & x[1:]


def dot(a: Float[Array, "d ..."], b: Float[Array, "d ..."]) -> Float[Array, "..."]:
    """Inner product along the first axis."""
    return (a * b).sum(0)
