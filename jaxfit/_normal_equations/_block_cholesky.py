"""Cholesky factors of a stencil, kept without roots, one row of the net at a time: S = X D X^T.

Numbered row by row the matrix is block-banded: a row of the net is coupled with the K - 1 next ones. Each
step inverts the block D of one row, n x n, and takes what it leaves off a window of K - 1 rows to come, so
that nearly all the work is a few products of matrices a step, and nothing outside the band is touched. Here n
is nv, or d nv where the matrix couples the d coordinates: then a row has all first ones, all second ones, ...

The blocks are inverted here. A call to LAPACK for each would be no faster, and its threads wait for one
another so badly where cores are shared that it may be a hundred times slower.
"""

from math import isqrt
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._normal_equations._coupled_stencil import CoupledStencil
from jaxfit._normal_equations._stencil import Stencil
from jaxfit._varying import as_varying

# Pivots below this share of the diagonal count as zero (with data enough they stay above 1e-5), and this
# share is then added to it. Solved for are corrections, so the shift does not bias what a few of them come
# to; a smaller one would let what the data does not determine grow by the inverse of its root.
LEAST_PIVOT = 1e-8
SHIFT = 1e-3
FLOOR = 0.1  # of the greatest diagonal entry: where the own is less, the share is of this
ROUNDING = (1e3, 1e5)  # the least of either in units of rounding, for single precision


class Factors(eqx.Module):
    """By rows of the net: `inverse_and_below[i]` is the inverse of block D of row i, and below it the K - 1
    blocks of X after it, with the other sign.

    `shift` is the share of the diagonal that had to be added: 0 unless the matrix is nearly singular.
    Where `transposed`, the directions of the net are exchanged.
    """

    inverse_and_below: Float[Array, "rows m n"]
    shift: Float[Array, ""]
    transposed: bool = eqx.field(static=True)


def factorise(stencil: Stencil | CoupledStencil, free: Bool[Array, "nu nv"]) -> Factors:
    """Factors of the matrix restricted to the free control points, the others having identity rows.

    A matrix that is nearly singular is shifted by a small multiple of its diagonal. Time
    O(rows (K n)^2 n) and memory O(rows K n^2), nv being the shorter side of the net.
    """
    transposed = free.shape[1] > free.shape[0]
    if transposed:
        stencil, free = stencil.with_directions_swapped(), free.T
    nu, nv = free.shape
    order_u, order_v = stencil.entries.shape[-4:-2]
    entries = jnp.asarray(stencil.entries).reshape(-1, order_u, order_v, nu, nv)
    d = isqrt(entries.shape[0])  # every coordinate with every other
    free = jnp.concatenate([free] * d, axis=1)
    eps = float(jnp.finfo(entries.dtype).eps)
    smallest, added = max(LEAST_PIVOT, ROUNDING[0] * eps), max(SHIFT, ROUNDING[1] * eps)

    def failed(carry: tuple[Any, Array, Array]) -> Array:
        (_, least), _, trials = carry
        return ~(least > smallest) & (trials < 2)

    def attempt(carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        trials = carry[2]
        shift = jnp.where(trials == 0, 0.0, added).astype(entries.dtype)
        return _factors(entries, free, shift), shift, trials + 1

    zero = jnp.zeros((), entries.dtype)
    blocks = (jnp.zeros((nu, order_u * d * nv, d * nv), entries.dtype), zero)
    begin = as_varying((blocks, zero, jnp.asarray(0, jnp.int32)), entries, free)
    (blocks, _), shift, _ = lax.while_loop(failed, attempt, begin)
    return Factors(blocks, shift, transposed)


def _factors(entries: Array, free: Array, shift: Array) -> tuple[Array, Array]:
    """Blocks of the factors, and the least pivot as a share of its diagonal entry."""
    order, (nu, n) = entries.shape[1], free.shape
    reach = (order - 1) * n
    ahead = jnp.pad(free, ((0, order - 1), (0, 0)))
    unit = jnp.eye(n, dtype=entries.dtype)
    with_themselves = range(0, entries.shape[0], isqrt(entries.shape[0]) + 1)
    diagonal = jnp.concatenate([entries[p, 0, 0] for p in with_themselves], axis=1)
    floor = FLOOR * jnp.max(diagonal)

    def step(window: list[Array], row: tuple[Array, ...]) -> tuple[list[Array], tuple[Array, ...]]:
        number, bands, diagonal = row
        mask = lax.dynamic_slice_in_dim(ahead, number, order)
        column = jnp.where(mask[:, :, None] & mask[0][None, None, :], _blocks(bands), 0.0)
        added = shift * unit * jnp.maximum(diagonal, floor)[:, None]
        own = jnp.where(mask[0][:, None], column[0] + added, unit)
        rest = column[1:].reshape(reach, n) - _with_row_below(window[0][n:])
        root, least = _inverse_root(own - window[0][:n], jnp.diagonal(own))
        half = rest @ root.T
        after = [half[j * n :] @ half[j * n : (j + 1) * n].T for j in range(order - 1)]
        kept = [_with_row_below(x) for x in window[1:]]
        after = [x + y for x, y in zip(kept, after, strict=False)] + after[order - 2 :]
        return after, (jnp.concatenate([root.T, -half]) @ root, least)

    def _with_row_below(x: Array) -> Array:
        return jnp.pad(x, ((0, n), (0, 0)))

    rows = (jnp.arange(nu, dtype=jnp.int32), entries.transpose(3, 1, 0, 2, 4), diagonal)
    # What is taken off the rows to come: by columns of blocks, from the diagonal down.
    window = [jnp.zeros((reach - j * n, n), entries.dtype) for j in range(order - 1)]
    _, (blocks, least) = lax.scan(step, as_varying(window, entries, free, shift), rows)
    return blocks, jnp.min(least)


def _inverse_root(block: Float[Array, "n n"], size: Float[Array, " n"]) -> tuple[Array, Array]:
    """R with R^T R the inverse of a positive definite matrix, and its least pivot as a share of `size`.

    By eliminating one row after the other. What a row leaves to the next ones is taken from R: taken from the
    inverse it would be wrong by rounding times the condition number of the block, not times its square root,
    and in single precision little would be left of smooth solutions.
    """
    count, dtype = block.shape[0], block.dtype
    number, unit = np.arange(count), np.eye(count, dtype=dtype)

    def eliminate(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        matrix, pivots = carry
        zero = np.zeros((), k.dtype)
        row = lax.dynamic_slice(matrix, (k, zero), (1, count), allow_negative_indices=False)
        column = lax.dynamic_slice(matrix, (zero, k), (count, 1), allow_negative_indices=False)
        pivot = lax.dynamic_slice(row, (zero, k), (1, 1), allow_negative_indices=False)
        across, after = number[None] == k, number[:, None] > k
        # The column that is eliminated makes room for one of the lower factor's inverse.
        share = lax.select(after, column / pivot, np.zeros_like(unit[:, :1]))
        share *= lax.select(across, np.ones_like(unit[:1]), row)
        rest = lax.select(jnp.broadcast_to(across, unit.shape), np.zeros_like(unit), matrix)
        pivots = lax.dynamic_update_slice(pivots, pivot, (k, zero), allow_negative_indices=False)
        return rest - share, pivots

    scale = size[:, None]
    matrix, pivots = lax.fori_loop(0, count, eliminate, (block, scale))
    lower = lax.select(number[:, None] > number, matrix, unit)
    smallest = max(LEAST_PIVOT, ROUNDING[0] * float(jnp.finfo(dtype).eps))
    return lower * lax.rsqrt(jnp.maximum(pivots, smallest * scale)), jnp.min(pivots / scale)


def _blocks(bands: Float[Array, "K pairs L nv"]) -> Float[Array, "K n n"]:
    """Dense symmetric blocks from their bands, `bands[:, p, b, j]` standing at (j, j + b) and (j + b, j) of
    the part for the pair p of coordinates.
    """
    blocks, pairs, order, count = bands.shape
    d = isqrt(pairs)
    p, i, q, j = (x.reshape(d * count, d * count) for x in np.indices((d, count, d, count), np.int32))
    # Entries farther from the diagonal are read from the zeros behind the bands.
    near = ((d * p + q) * order + abs(i - j)) * count + np.minimum(i, j)
    place = np.where(abs(i - j) < order, near, pairs * order * count)
    flat = jnp.pad(bands.reshape(blocks, pairs * order * count), ((0, 0), (0, 1)))
    return jnp.take(flat, place, axis=1, mode="clip")


def substitute(factors: Factors, right: Float[Array, "c nu nv"]) -> Float[Array, "c nu nv"]:
    """The solution with the factors, forward and backward, the channels first; control points not free get
    their right side. Channels that the matrix couples are its coordinates.
    """
    by_rows = (2, 0, 1) if factors.transposed else (1, 0, 2)
    right = right.transpose(by_rows)
    shape, count = right.shape, factors.inverse_and_below.shape[2]
    right = right.reshape(shape[0], -1, count)
    channels, reach = right.shape[1], factors.inverse_and_below.shape[1] - count

    def forward(window: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        blocks, value = row
        value = value + window[:, :count]
        return jnp.pad(window[:, count:], ((0, 0), (0, count))) + value @ blocks[count:].T, value

    def backward(later: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        blocks, value = row
        value = jnp.concatenate([value, later], axis=1) @ blocks
        return jnp.concatenate([value, later[:, : reach - count]], axis=1), value

    none = as_varying(jnp.zeros((channels, reach), right.dtype), factors, right)
    _, half = lax.scan(forward, none, (factors.inverse_and_below, right))
    _, whole = lax.scan(backward, none, (factors.inverse_and_below, half), reverse=True)
    return whole.reshape(shape).transpose(np.argsort(by_rows))
