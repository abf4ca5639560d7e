"""Which parameters are inside a set of loops: an odd number of edges is to their right."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

Edges = Float[np.ndarray, "edges 2 2"]  # start and end of each
_BLOCK = 4096  # points, so that the comparisons with all edges stay in the cache


@jax.jit
def inside_loops(
    edges: Float[Array, "edges 2 2"], u: Float[Array, "*shape"], v: Float[Array, "*shape"]
) -> Bool[Array, "*shape"]:
    """Whether each (u, v) is inside. On a loop itself either answer may come."""
    (ua, va), (ub, vb) = edges[:, 0].T, edges[:, 1].T
    rise = jnp.where(va == vb, 1.0, vb - va)  # level edges are never crossed
    slope = (ub - ua) / rise

    def one(point: tuple[Array, Array]) -> Bool[Array, ""]:
        at, height = point
        crossed = (va > height) != (vb > height)
        return jnp.sum(crossed & (ua + slope * (height - va) > at)) % 2 == 1

    flat = jax.lax.map(one, (u.reshape(-1), v.reshape(-1)), batch_size=_BLOCK)
    return flat.reshape(u.shape)


def inside_on_host(edges: Edges, points: Float[np.ndarray, "points 2"]) -> Bool[np.ndarray, " points"]:
    """The same by NumPy, edge by edge: each looks only at the points beside it, and nothing compiles."""
    order = np.argsort(points[:, 1], kind="stable")
    u, v = points[order].T
    inside = np.zeros(len(points), bool)
    for rows, height, slope, at in _rising(edges, v):
        inside[rows] ^= at + slope * (v[rows] - height) > u[rows]
    result = np.empty_like(inside)
    result[order] = inside
    return result


def inside_on_grid(
    edges: Edges, us: Float[np.ndarray, " a"], vs: Float[np.ndarray, " b"]
) -> Bool[np.ndarray, "a b"]:
    """The same at all combinations of sorted `us` and `vs`."""
    parity = np.zeros((len(us) + 1, len(vs)), np.int64)
    for rows, height, slope, at in _rising(edges, vs):
        first_right = np.searchsorted(us, at + slope * (vs[rows] - height))
        parity[first_right, np.arange(rows.start, rows.stop)] += 1
    # An edge counts for all points to its left.
    return np.cumsum(parity[::-1], axis=0)[::-1][1:] % 2 == 1


def _rising(edges: Edges, v: Float[np.ndarray, " k"]) -> Iterator[tuple[slice, float, float, float]]:
    """Of each edge that passes any of the sorted heights: which, its lower end (v), slope du/dv, lower u."""
    low, high = (np.take_along_axis(edges, np.argsort(edges[:, :, 1:], axis=1), axis=1)[:, k] for k in (0, 1))
    first, last = np.searchsorted(v, low[:, 1]), np.searchsorted(v, high[:, 1])
    for i in np.flatnonzero(first < last).tolist():
        slope = (high[i, 0] - low[i, 0]) / (high[i, 1] - low[i, 1])
        yield slice(int(first[i]), int(last[i])), float(low[i, 1]), float(slope), float(low[i, 0])
