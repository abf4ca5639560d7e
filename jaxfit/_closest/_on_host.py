"""Concrete queries: padded to a common size, and searched for globally where there is no start."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._cells import values_at
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._project import project
from jaxfit._closest._rivals import Search
from jaxfit._closest._seeds import Samples, sample
from jaxfit._precision import bucket
from jaxfit._splines._pieces import Axis, Pieces, pieces_on

CHUNK = 1 << 16
HostFeet = dict[str, np.ndarray]  # u, v, f (squared distance), converged, steps; one entry a point


class Prepared(eqx.Module):
    """A surface made ready for many queries: centred pieces, and samples to start from."""

    pieces: Pieces
    centre: Float[np.ndarray, " d"]
    samples: Samples | None


def prepare(net: Any, axis_u: Axis, axis_v: Axis, sampled: bool) -> Prepared:
    """Pieces about the middle of the net, where coordinates carry the least rounding (concrete)."""
    dtype, net = net.dtype, np.asarray(net, np.float64)
    centre = 0.5 * (net.min(axis=(0, 1)) + net.max(axis=(0, 1)))
    pieces = pieces_on((net - centre[None, None, :]).astype(dtype), axis_u, axis_v)
    samples = sample(pieces) if sampled else None
    return Prepared(jax.device_put(pieces), centre, samples)


@partial(jax.jit, static_argnames=("method", "borders"))
def _run(
    method: AbstractFootMethod,
    pieces: Pieces,
    target: Array,
    u: Array,
    v: Array,
    idle: Array,
    tolerance: Array,
    max_steps: Array,
    borders: bool,
) -> dict[str, Array]:
    feet = project(method, pieces, target, u, v, tolerance, max_steps, idle, borders)
    return {
        "u": feet.best_u,
        "v": feet.best_v,
        "f": feet.best,
        "converged": feet.converged,
        "steps": feet.steps,
        "point": values_at(pieces, feet.best_u, feet.best_v),
    }


def feet_on_host(
    method: AbstractFootMethod,
    net: Any,
    axis_u: Axis,
    axis_v: Axis,
    points: np.ndarray,
    start: tuple[Any, Any] | None,
    tolerance: float,
    max_steps: int,
) -> HostFeet:
    """Feet of all points, and the points on the surface; `tolerance` is a fraction of the extent."""
    prepared = prepare(net, axis_u, axis_v, sampled=start is None)
    dtype = np.dtype(net.dtype)
    size = chunk_size(len(points))
    centred = np.empty(points.shape[::-1])
    np.subtract(points.T, prepared.centre[:, None], out=centred)
    limits = (dtype.type(tolerance * _extent(net, prepared.centre, centred)), np.int32(max_steps))

    def feet_of_chunk(*inputs: np.ndarray, borders: bool) -> dict[str, Array]:
        idle = np.arange(size) >= inputs[0].shape[-1]
        inputs = tuple(padded(x, size).astype(dtype, copy=False) for x in inputs)
        return _run(method, prepared.pieces, *inputs, idle, *limits, borders)

    def feet_from(which: Any, u: Any, v: Any, borders: bool = False) -> HostFeet:
        """Feet of the points `which`, from (u, v); always the same shapes."""
        chosen = centred if which is None else centred[:, which]
        inputs = (chosen, np.asarray(u), np.asarray(v))
        return in_chunks(partial(feet_of_chunk, borders=borders), inputs, size)

    if start is not None:
        best = feet_from(None, *start)
    else:
        best = globally(feet_from, prepared.samples, centred.T, size)
    lost = np.flatnonzero(~best["converged"])
    if lost.size:  # rare, so the search on the borders is compiled only now
        best = {name: np.array(x) for name, x in best.items()}
        take_nearer(best, lost, feet_from(lost, best["u"][lost], best["v"][lost], borders=True))
    best["point"] = best["point"].T + prepared.centre.astype(dtype)[None, :]
    return best


def chunk_size(count: int) -> int:
    """The padded size that clouds are cut into: chunks keep the CPU's cores busy and memory in its caches."""
    most = CHUNK if jax.default_backend() == "cpu" else count
    return bucket(-(-count // -(-count // most)))


def in_chunks(function: Any, arrays: tuple[np.ndarray, ...], size: int) -> HostFeet:
    """`function` of arrays cut along their last axis, a thread for each core, the results put together."""
    count = arrays[0].shape[-1]
    parts = [slice(begin, min(begin + size, count)) for begin in range(0, count, size)]

    def one(part: slice) -> HostFeet:
        found = function(*(x[..., part] for x in arrays))
        return {name: np.asarray(x)[..., : part.stop - part.start] for name, x in found.items()}

    if len(parts) == 1:
        return one(parts[0])
    with ThreadPoolExecutor(min(len(parts), os.cpu_count() or 1)) as pool:
        pieces = list(pool.map(one, parts))
    return {name: np.concatenate([piece[name] for piece in pieces], axis=-1) for name in pieces[0]}


def _extent(net: Any, centre: np.ndarray, centred: np.ndarray) -> float:
    """Diagonal of the box around control points and queries."""
    net = np.asarray(net, np.float64).reshape(-1, len(centre)) - centre[None, :]
    low = np.minimum(net.min(axis=0), centred.min(axis=1))
    high = np.maximum(net.max(axis=0), centred.max(axis=1))
    return float(np.linalg.norm(high - low))


def padded(x: np.ndarray, size: int) -> np.ndarray:
    """The last axis filled up to `size` with its last entry."""
    filling = size - x.shape[-1]
    if not filling:
        return x
    return np.concatenate([x, np.repeat(x[..., -1:], filling, axis=-1)], axis=-1)


def globally(
    feet_from: Any,
    samples: Samples | None,
    points: np.ndarray,
    size: int,
    known: HostFeet | None = None,
) -> HostFeet:
    """The nearest foot of all: from the nearest sample, then from every rival that is left.

    `feet_from(which, u, v)` gives the feet of some points (None: all) from starts, at most `size` at a time;
    `known` feet take the place of those from the nearest samples.
    """
    assert samples is not None
    search = Search(samples, points)
    begun = feet_from(None, *search.nearest()) if known is None else known
    best = {name: np.array(x) for name, x in begun.items()}
    rivals = search.rivals(best["u"], best["v"], np.sqrt(best["f"].astype(np.float64)))
    if len(rivals.who) > size:  # so many that it pays to drop those next to feet found first
        which, u, v = rivals.first()
        other = feet_from(which, u, v)
        everywhere_u, everywhere_v = best["u"].copy(), best["v"].copy()
        everywhere_u[which], everywhere_v[which] = other["u"], other["v"]
        rivals.found(everywhere_u, everywhere_v)
        take_nearer(best, which, other)
    which, u, v = rivals.rest()
    for begin in range(0, which.size, size):
        part = slice(begin, begin + size)
        take_nearer(best, which[part], feet_from(which[part], u[part], v[part]))
    return best


def take_nearer(best: HostFeet, which: np.ndarray, other: HostFeet) -> None:
    """Replace feet by nearer ones; `which` may name a point several times."""
    np.add.at(best["steps"], which, other["steps"])
    # Of each point's, the converged ones first and of these the nearest.
    order = np.lexsort((other["f"], ~other["converged"], which))
    first = order[np.unique(which[order], return_index=True)[1]]
    mine = which[first]
    nearer = other["f"][first] < best["f"][mine]
    nearer &= other["converged"][first] | ~best["converged"][mine]
    for name in best.keys() - {"steps"}:
        best[name][..., mine[nearer]] = other[name][..., first[nearer]]
