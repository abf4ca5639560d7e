"""Cholesky factors of a stencil, one row of the net at a time.

Numbered row by row the matrix is block-banded: a row of the net is coupled with the K - 1 next ones. Each step
factors the nv x nv block of one row and takes what it leaves off a window of K - 1 rows to come, so that
nearly all the work is one product of matrices a step, and nothing outside the band is touched.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._normal._stencil import Stencil

# Pivots below so many rounding units, relative to the diagonal, count as zero; and the share of the diagonal
# that is then added to it, which is enough to keep them away from there.
LEAST_PIVOT = 1e3
SHIFT = 1e5


class Factors(eqx.Module):
    """The lower factor by rows of the net: `diagonal[i]` of row i, `below[i]` of the K - 1 rows after it.

    `shift` is the share of the diagonal that had to be added: 0 unless the matrix is singular to rounding.
    Where `turned`, the directions of the net are exchanged.
    """

    diagonal: Float[Array, "rows n n"]
    below: Float[Array, "rows m n"]
    free: Bool[Array, "rows n"]
    shift: Float[Array, ""]
    turned: bool = eqx.field(static=True)


def factorise(stencil: Stencil, free: Bool[Array, "nu nv"]) -> Factors:
    """Factors of the matrix restricted to the free control points, the others having identity rows.

    A matrix that is singular to rounding is shifted by a small multiple of its diagonal. Time
    O(rows (K n)^2 n) and memory O(rows K n^2), n being the shorter side of the net.
    """
    turned = free.shape[1] > free.shape[0]
    if turned:
        stencil, free = stencil.transposed(), free.T
    eps = jnp.finfo(stencil.entries.dtype).eps
    entries = jnp.asarray(stencil.entries)

    def attempt(shift: Array) -> tuple[Array, Array, Array]:
        diagonal, below, least = _factors(entries, free, shift)
        return diagonal, below, least

    def failed(carry: tuple[Any, Array, Array]) -> Array:
        return ~(carry[0][2] > LEAST_PIVOT * eps) & (carry[2] < 2)

    def again(carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        shift = jnp.where(carry[2] == 0, 0.0, SHIFT * eps).astype(entries.dtype)
        return attempt(shift), shift, carry[2] + 1

    nu, nv = free.shape
    order = entries.shape[0]
    empty = jnp.zeros((nu, nv, nv), entries.dtype)
    nothing = (empty, jnp.zeros((nu, (order - 1) * nv, nv), entries.dtype), jnp.asarray(0.0, entries.dtype))
    begin = (nothing, jnp.asarray(0.0, entries.dtype), jnp.asarray(0, jnp.int32))
    (diagonal, below, _), shift, _ = lax.while_loop(failed, again, begin)
    return Factors(diagonal, below, free, shift, turned)


def _factors(entries: Array, free: Array, shift: Array) -> tuple[Array, Array, Array]:
    """Blocks of the factor, and the least pivot as a share of its diagonal entry."""
    order, _, nu, nv = entries.shape
    ahead = jnp.pad(free, ((0, order - 1), (0, 0)))
    unit = jnp.eye(nv, dtype=entries.dtype)
    scale = unit * shift

    def step(window: Array, row: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array, Array]]:
        number, bands = row
        mask = lax.dynamic_slice_in_dim(ahead, number, order)
        column = _blocks(bands) * (mask[:, :, None] & mask[0][None, None, :])
        column = column.at[0].add(column[0] * scale + jnp.where(mask[0], 0.0, 1.0)[:, None] * unit)
        was = jnp.diagonal(column[0])
        column = column.reshape(order * nv, nv)
        column = column.at[: (order - 1) * nv].add(-window[:, :nv])
        lower = lax.linalg.cholesky(column[:nv], symmetrize_input=False)
        below = lax.linalg.triangular_solve(
            lower, column[nv:], left_side=False, lower=True, transpose_a=True
        )
        least = jnp.min(jnp.diagonal(lower) ** 2 / was)
        rest = below @ below.T
        if order > 2:
            rest = rest.at[:-nv, :-nv].add(window[nv:, nv:])
        return rest, (lower, below, least)

    window = jnp.zeros(((order - 1) * nv,) * 2, entries.dtype)
    rows = (jnp.arange(nu, dtype=jnp.int32), entries.transpose(2, 0, 1, 3))
    _, (diagonal, below, least) = lax.scan(step, window, rows)
    return diagonal, below, jnp.min(least)


def _blocks(bands: Float[Array, "K L n"]) -> Float[Array, "K n n"]:
    """Dense symmetric blocks from their bands, `bands[:, b, j]` standing at (j, j + b) and (j + b, j)."""
    _, order, count = bands.shape
    number = jnp.arange(count)
    apart = number[None, :] - number[:, None]
    total: Any = jnp.where(apart == 0, bands[:, 0, :, None], 0.0)
    for b in range(1, order):
        total = jnp.where(apart == b, bands[:, b, :, None], total)
        total = jnp.where(apart == -b, bands[:, b, None, :], total)
    return total


def substitute(factors: Factors, right: Float[Array, "nu nv c"]) -> Float[Array, "nu nv c"]:
    """The solution with the factors, forward and backward; right-hand sides of fixed control points return."""
    if factors.turned:
        right = right.transpose(1, 0, 2)
    reach = factors.below.shape[1]
    count, channels = right.shape[1:]

    def forward(window: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, below, value = row
        value = lax.linalg.triangular_solve(lower, value - window[:count], left_side=True, lower=True)
        window = jnp.concatenate([window[count:], jnp.zeros((count, channels), value.dtype)])
        return window + below @ value, value

    def backward(later: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        lower, below, value = row
        value = value - below.T @ later
        value = lax.linalg.triangular_solve(lower, value, left_side=True, lower=True, transpose_a=True)
        return jnp.concatenate([value, later[: reach - count]]), value

    none = jnp.zeros((reach, channels), right.dtype)
    _, half = lax.scan(forward, none, (factors.diagonal, factors.below, right))
    _, whole = lax.scan(backward, none, (factors.diagonal, factors.below, half), reverse=True)
    return whole.transpose(1, 0, 2) if factors.turned else whole
