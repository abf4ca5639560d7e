"""Points of a cloud in chunks of one size, cut so that neighbours come together, a thread for each core."""

from typing import Any

import jax
import numpy as np

from jaxfit._cores import cores, on_all_cores
from jaxfit._precision import bucket
from jaxfit._splines._pieces import Axis

CHUNK = 1 << 15  # points at a time: one program serves all clouds that have more
HostFeet = dict[str, np.ndarray]  # u, v, f (squared distance) or distance, converged, steps; by point


def chunk_size(count: int) -> int:
    """The padded size that clouds are cut into: chunks keep a CPU's cores busy and memory in its caches."""
    return CHUNK if jax.default_backend() == "cpu" and count > CHUNK else bucket(count)


def in_chunks(
    function: Any, arrays: tuple[np.ndarray, ...], size: int, order: np.ndarray | None = None
) -> HostFeet:
    """`function` of arrays cut along their last axis into parts of at most `size`, a thread for each core;
    the results are put together. The parts are cut from the entries in this `order`.
    """
    count = arrays[0].shape[-1]
    number, threads = -(-count // size), cores()
    if number > 1:  # as many for every thread
        number = -(-number // threads) * threads
    step = -(-count // number)
    parts = [slice(begin, min(begin + step, count)) for begin in range(0, count, step)]

    def one(part: slice) -> HostFeet:
        cut = (x[..., part] if order is None else x.take(order[part], axis=-1) for x in arrays)
        return {name: np.asarray(x)[..., : part.stop - part.start] for name, x in function(*cut).items()}

    pieces = on_all_cores(one, parts)
    if len(pieces) == 1:
        return pieces[0]
    whole = {name: np.concatenate([piece[name] for piece in pieces], axis=-1) for name in pieces[0]}
    if order is None:
        return whole
    back = np.empty_like(order)
    back[order] = np.arange(count)
    return {name: x.take(back, axis=-1) for name, x in whole.items()}


def neighbours_together(axes: tuple[Axis, Axis], u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The order of points in which those of one place follow one another."""
    return np.argsort(places(axes, u, v), kind="stable")


def places(axes: tuple[Axis, Axis], u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The rectangles of a uniform grid in which (u, v) lie, numbered row by row; there are as many as cells.

    They are the cells if knots are uniform, and take a tenth of the time to find.
    """
    number = np.zeros(u.shape, np.int32)
    for axis, x in zip(axes, (u, v), strict=True):
        first, last = axis.breaks[0], axis.breaks[-1]
        place = (x - first) * (axis.cells / (last - first))
        number = number * axis.cells + np.clip(place, 0, axis.cells - 1).astype(np.int32)
    few = axes[0].cells * axes[1].cells < 1 << 16
    return number.astype(np.uint16) if few else number  # which NumPy sorts in linear time


def padded(x: np.ndarray, size: int) -> np.ndarray:
    """The last axis filled up to `size` with its last entry."""
    filling = size - x.shape[-1]
    if not filling:
        return x
    return np.concatenate([x, np.repeat(x[..., -1:], filling, axis=-1)], axis=-1)
