"""Which parameters are inside a set of loops: an odd number of edges is to their right."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit._trimmed._checked_loops import Edges

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


def inside_on_grid(
    edges: Edges, us: Float[np.ndarray, " a"], vs: Float[np.ndarray, " b"]
) -> Bool[np.ndarray, "a b"]:
    """The same at all combinations of sorted `us` and `vs`, on the host: edge by edge, not point by point."""
    parity = np.zeros((len(us) + 1, len(vs)), np.int64)
    for start, end in edges:
        (ua, va), (ub, vb) = (start, end) if start[1] < end[1] else (end, start)
        rows = slice(*np.searchsorted(vs, (va, vb)).tolist())
        if rows.start < rows.stop:
            at = ua + (vs[rows] - va) * ((ub - ua) / (vb - va))
            parity[np.searchsorted(us, at), np.arange(rows.start, rows.stop)] += 1
    # An edge counts for all points to its left.
    return np.cumsum(parity[::-1], axis=0)[::-1][1:] % 2 == 1
