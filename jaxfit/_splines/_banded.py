r"""Banded systems of B-spline collocation, $\sum_j N_{j,K}(u_i) P_j = Q_i$, in time O(n K^2).

A square matrix whose rows have at most K - 1 entries on either side of the diagonal is held as its *band*,
`band[i, K - 1 + j - i]` being the entry (i, j); entries outside the matrix are zero.

Collocation matrices of increasing parameters are totally positive, so elimination without pivoting is
stable, with no growth at all (de Boor and Pinkus, Numer. Math. 27, 1977), and the factors keep the band. Each
step works on whole rows of right-hand sides: one loop over rows with all columns side by side is faster
than a dense or a blocked factorisation up to 400 rows and more.
"""

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._splines._basis import spans_and_weights
from jaxfit._varying import as_varying

UNROLL = 2  # rows per iteration of a loop over right-hand sides


def collocation_band(
    knots: Float[Array, " knots"],
    order: int,
    u: Float[Array, " parameters"],
    derivatives: tuple[int, ...] = (0,),
) -> Float[Array, "n band"]:
    r"""Band of the matrix $N_{j,K}(u_i)$ for as many increasing parameters as control points.

    With several `derivatives` every parameter has a row for each of them; (0, 1) is Hermite interpolation,
    with half as many parameters as control points. They come in this order, and in the reverse order at the
    last parameter, the right end of the domain: elimination then needs no pivoting there either.

    Parameters that meet the Schoenberg-Whitney condition $N_{i,K}(u_i) > 0$ have all their basis functions
    in the band; what others have outside is dropped.
    """
    first, weights = spans_and_weights(knots, order, u, derivatives, False)
    entries = weights.transpose(2, 0, 1)
    entries = jnp.concatenate([entries[:-1], entries[-1:, ::-1]])
    count = u.shape[0] * len(derivatives)
    row = jnp.arange(count)
    place = (jnp.repeat(first, len(derivatives)) - row + order - 1)[:, None] + jnp.arange(order)[None, :]
    place = jnp.where(place < 0, 2 * order - 1, place)  # a negative index would wrap round
    band = jnp.zeros((count, 2 * order - 1), entries.dtype)
    return band.at[row[:, None], place].set(entries.reshape(count, order), mode="drop")


def transposed(band: Float[Array, "n band"]) -> Float[Array, "n band"]:
    """The band of the transposed matrix."""
    count, width = band.shape
    reach = (width - 1) // 2
    padded = jnp.pad(band, ((reach, reach), (0, 0)))
    # Entry (i, i + k) of the transposed matrix is entry (i + k, i) of the matrix.
    return jnp.stack([padded[k : k + count, width - 1 - k] for k in range(width)], axis=1)


def times(band: Float[Array, "n band"], x: Float[Array, "..."], axis: int = 0) -> Float[Array, "..."]:
    """The matrix times `x` along one axis of `x`, which has length n."""
    count, width = band.shape
    reach = (width - 1) // 2
    padded = jnp.pad(x, [(reach, reach) if each == axis else (0, 0) for each in range(x.ndim)])
    diagonals = lax.broadcast_in_dim(band.T, (width, *x.shape), (0, axis + 1))
    total = jnp.zeros_like(x)
    for k in range(width):
        total = total + diagonals[k] * lax.slice_in_dim(padded, k, k + count, axis=axis)
    return total


def factorise(band: Float[Array, "n band"]) -> tuple[Array, Array]:
    """Factors of the matrix without pivoting: the multipliers of the K - 1 rows above each row, and each
    row of the upper factor from the diagonal on, the diagonal inverted."""
    reach = (band.shape[1] - 1) // 2

    def eliminate(above: Array, row: Array) -> tuple[Array, tuple[Array, Array]]:
        entries = [row[k] for k in range(row.shape[0])]
        multipliers = []
        for a in range(reach):
            factor = entries[a] * above[a, 0]
            multipliers.append(factor)
            for b in range(1, reach + 1):
                entries[a + b] = entries[a + b] - factor * above[a, b]
        rest = jnp.stack([1.0 / entries[reach], *entries[reach + 1 :]])
        return jnp.concatenate([above[1:], rest[None]]), (jnp.stack(multipliers), rest)

    identity = jnp.zeros((reach, reach + 1), band.dtype).at[:, 0].set(1.0)
    return lax.scan(eliminate, as_varying(identity, band), band)[1]


def substitute(factors: tuple[Array, Array], right: Float[Array, "n columns"]) -> Float[Array, "n columns"]:
    """Solve with the factors: forward with the multipliers, backward with the upper factor."""
    lower, upper = factors
    reach = lower.shape[1]
    Rows = tuple[Array, ...]

    def forward(above: Rows, row: tuple[Array, Array]) -> tuple[Rows, Array]:
        multipliers, value = row
        for a in range(reach):
            value = value - multipliers[a] * above[a]
        return (*above[1:], value), value

    def backward(below: Rows, row: tuple[Array, Array]) -> tuple[Rows, Array]:
        entries, value = row
        for a in range(reach):
            value = value - entries[a + 1] * below[a]
        value = value * entries[0]
        return (value, *below[:-1]), value

    none = (jnp.zeros_like(right[0]),) * reach
    _, half = lax.scan(forward, none, (lower, right), unroll=UNROLL)
    return lax.scan(backward, none, (upper, half), reverse=True, unroll=UNROLL)[1]


@jax.custom_jvp
def solve(band: Float[Array, "n band"], right: Float[Array, "n columns"]) -> Float[Array, "n columns"]:
    """The solution of the banded system, differentiable in the matrix and in the right-hand sides.

    Derivatives are those of the solution, not of the elimination: they cost one more solve, with the
    transposed band in reverse mode.
    """
    return substitute(factorise(band), right)


@solve.defjvp
def _solve_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (band, _), (d_band, d_right) = primals, tangents
    solution, fixed = solve(*primals), lax.stop_gradient(band)
    change = lax.custom_linear_solve(
        lambda x: times(band, x),
        d_right - times(d_band, solution),
        solve=lambda _, b: substitute(factorise(fixed), b),
        transpose_solve=lambda _, b: substitute(factorise(transposed(fixed)), b),
    )
    return solution, change
