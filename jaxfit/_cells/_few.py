"""Few points out of many: which they are, and rows for them alone."""

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxfit._cells._layout import cells_of
from jaxfit._cells._rows import Rows
from jaxfit._splines._pieces import Pieces

# Points that are looked up one by one: one of so many, within bounds.
ONE_OF = 128
LEAST_FEW, MOST_FEW = 64, 1024
BITS = 32  # of a word of flags
HALVES = (16, 8, 4, 2, 1)


def few_among(points: int) -> int:
    """How many out of so many points count as few."""
    return min(points, max(LEAST_FEW, min(MOST_FEW, points // ONE_OF)))


def few_of(mask: Bool[Array, " points"], few: int) -> Int[Array, " few"]:
    """The numbers of the first `few` points with `mask`, ascending; after the last the number of points.

    Flags are packed into words, and the k-th one that is set is found by counting bits: first over words,
    then over halves of halves of one. Several times as quick as `jnp.nonzero`, which adds up flag by flag.
    """
    points = mask.shape[0]
    words = -(-points // BITS)
    flags = jnp.pad(mask, (0, words * BITS - points)).reshape(words, BITS).astype(jnp.uint32)
    word = jnp.sum(flags << jnp.arange(BITS, dtype=jnp.uint32)[None], axis=1, dtype=jnp.uint32)
    ones = _ones(word)
    until = jnp.cumsum(ones, dtype=jnp.int32)
    rank = jnp.arange(min(few, points), dtype=jnp.int32)
    home = jnp.searchsorted(until, rank, side="right", method="scan_unrolled").astype(jnp.int32)
    at = jnp.minimum(home, words - 1)
    rest, rank, place = word[at], rank - (until[at] - ones[at]), jnp.zeros_like(rank)
    for half in HALVES:
        low = rest & jnp.uint32((1 << half) - 1)
        count = _ones(low)
        above = rank >= count
        rank, place = jnp.where(above, rank - count, rank), jnp.where(above, place + half, place)
        rest = jnp.where(above, rest >> half, low)
    return jnp.where(home < words, at * BITS + place, points)


def _ones(word: Array) -> Array:
    return lax.population_count(word).astype(jnp.int32)


def rows_of_few(
    pieces: Pieces,
    u: Float[Array, " points"],
    v: Float[Array, " points"],
    number: Int[Array, " few"],
    count: Int[Array, ""],
) -> Rows:
    """A row for each of the points that `few_of` has found, `count` of them."""
    points = u.shape[0]
    at = jnp.minimum(number, points - 1)
    return Rows(cells_of(pieces, u[at], v[at]), number[:, None], count, points)
