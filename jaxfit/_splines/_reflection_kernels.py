"""The arithmetic behind `Reflection`: mirror images, best normal, and means that are symmetric to the bit.

Every function takes the paired index first.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxfit._compile import compiled
from jaxfit._unrolling import root_with_slope

# Of symmetric data the leading eigenvalue stands above the others by the whole sum of squared differences;
# a direction that does so by less than this share of it is no direction.
_LEAST_GAP = 0.01


@compiled
def mirrored(
    points: Float[Array, "*shape d"], point: Float[Array, " d"], normal: Float[Array, " d"]
) -> Float[Array, "*shape d"]:
    """Mirror images x - 2 ((x - c) . n) n of points about the plane through c with unit normal n."""
    return points - 2 * _off_plane(points, point, normal)


@compiled
def averaged(
    rows: Float[Array, "h m d"],
    partners: Float[Array, "h m d"],
    point: Float[Array, " d"],
    normal: Float[Array, " d"],
) -> Float[Array, "h m d"]:
    """The mean of points and the mirror images of their partners."""
    return (rows + mirrored(partners, point, normal)) / 2


@compiled
def onto_plane(
    points: Float[Array, "*shape d"], point: Float[Array, " d"], normal: Float[Array, " d"]
) -> Float[Array, "*shape d"]:
    """The nearest points of the plane."""
    for _ in range(2):  # the second time removes the rounding of the first
        points = points - _off_plane(points, point, normal)
    return points


def _off_plane(points: Array, point: Array, normal: Array) -> Array:
    """The part of x - c along the normal."""
    centre, along = (jnp.broadcast_to(x, points.shape) for x in (point, normal))
    return jnp.sum((points - centre) * along, axis=-1, keepdims=True) * along


@compiled
def best_normal(
    rows: Float[Array, "n m d"], point: Float[Array, " d"]
) -> tuple[Float[Array, " d"], Bool[Array, ""]]:
    """The normal with the least squared deviations of pairs, and whether it is well determined.

    With D the difference and m the midpoint of a pair, the deviation from the mirror image is
    |D|^2 - (n . D)^2 + 4 (n . (m - c))^2; its sum is least for the leading eigenvector of
    S = sum D D^T - 4 (m - c)(m - c)^T.
    """
    d = rows.shape[-1]
    across = (rows[::-1] - rows).reshape(-1, d)
    middle = ((rows[::-1] + rows) / 2).reshape(-1, d)
    middle = middle - jnp.broadcast_to(point, middle.shape)
    largest = lax.stop_gradient(jnp.maximum(jnp.max(jnp.abs(across)), jnp.max(jnp.abs(middle))))
    scale = jnp.where(largest > 0, largest, 1)  # squares must stay in the number range
    across, middle = across / scale, middle / scale
    differences = _square(across)
    midpoints = 4 * _square(middle)
    matrix = differences - midpoints
    values, vectors = jnp.linalg.eigh(lax.stop_gradient(matrix))
    second = jnp.max(values[:-1], initial=0.0)
    spread = jnp.trace(differences)
    rounding = 64 * float(jnp.finfo(rows.dtype).eps) * (spread + jnp.trace(midpoints))
    clear = values[-1] - second > _LEAST_GAP * spread + rounding
    normal = _with_derivative(matrix, values, vectors)
    # From the first rows to the last: the sign of an eigenvector is a whim of the solver.
    forward = jnp.sum(across[: (rows.shape[0] // 2) * rows.shape[1]], axis=0)
    return jnp.where(jnp.dot(forward, normal) < 0, -normal, normal), clear


def _square(vectors: Array) -> Array:
    """The sum of x x^T."""
    return jnp.matmul(vectors.T, vectors, precision=lax.Precision.HIGHEST)


def _with_derivative(matrix: Array, values: Array, vectors: Array) -> Array:
    """The leading eigenvector, differentiable where it is simple, whatever the others are.

    The derivative that comes with `eigh` is infinite as soon as any two eigenvalues coincide, as they do
    for all but one where a grid is planar. First-order perturbation theory needs the gaps to the
    first one only; its correction is zero but for its derivative.
    """
    lead, others = vectors[:, -1], vectors[:, :-1]
    gaps = values[-1] - values[:-1]
    distinct = gaps > float(jnp.finfo(gaps.dtype).eps) * jnp.max(jnp.abs(values))
    inverse = jnp.where(distinct, 1 / jnp.where(distinct, gaps, 1), 0)
    slopes = jnp.matmul(others.T, jnp.matmul(matrix, lead, precision=lax.Precision.HIGHEST))
    return unit(lead + others @ (inverse * slopes))


@compiled
def unit(vector: Float[Array, " d"]) -> Float[Array, " d"]:
    """The vector over its length."""
    scaled = vector / jnp.max(jnp.abs(lax.stop_gradient(vector)))
    return scaled / jnp.sqrt(jnp.sum(scaled**2))


@compiled
def reversal_mean(
    values: Float[Array, "n *rest"], start: Float[Array, ""], stop: Float[Array, ""]
) -> Float[Array, "n *rest"]:
    """The mean of values and of start + stop less the same values read backwards."""
    n = values.shape[0]
    half = n // 2
    high, low = values[n - half :], values[:half][::-1]
    # The later half first: on [0, 1] it lies above 1/2, where 1 - t and 1 - (1 - t) round nothing.
    # Measured from `high`, so that what is symmetric already keeps every bit.
    high = high + ((stop - low) - (high - start)) / 2
    middle = jnp.full((n - 2 * half, *values.shape[1:]), start + (stop - start) / 2)
    return jnp.concatenate([start + (stop - high)[::-1], middle, high])


@compiled
def largest_distance(a: Float[Array, "*shape d"], b: Float[Array, "*shape d"]) -> Float[Array, ""]:
    """The largest distance of corresponding points, with gradient zero where all coincide."""
    return root_with_slope(jnp.max(jnp.sum((a - b) ** 2, axis=-1)))
