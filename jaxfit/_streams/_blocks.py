"""`Blocks`: a cloud that is read again and again, one block of points at a time."""

import mmap
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxfit._checks import as_points, said_missing

Source = str | os.PathLike[str] | np.ndarray | Iterable[Any] | Callable[[], Iterable[Any]]
Points = Float[np.ndarray, "points d"]


class Blocks:
    """The points of a source in blocks of `size`, the last one shorter. Every iteration reads it anew.

    Every array that is read is checked, and named by its place where something is wrong.
    """

    def __init__(self, source: Source, dimension: int, size: int):
        self.source, self.dimension, self.size = source, dimension, size
        self.count: int | None = None  # known once all have been read
        if isinstance(source, jax.core.Tracer):
            raise TypeError("source must not be traced by jit, vmap or grad; use approximate there.")
        if isinstance(source, (str, os.PathLike)):
            self.source = _mapped(source)
        if isinstance(source, jax.Array):
            self.source = np.asarray(source)
        if isinstance(self.source, np.ndarray):
            _check_shape(self.source, dimension)
        elif not callable(source) and (not isinstance(source, Iterable) or iter(source) is source):
            raise TypeError(
                "source must be an array, the path of a .npy file, or something that can be iterated again "
                f"and again, but is a {type(source).__name__}; pass a function that returns an iterator of "
                "arrays."
            )

    def __iter__(self) -> Iterator[tuple[int, Points]]:
        """The number of a block's first point, and its points."""
        count = 0
        for start, block in _cut(self._arrays(), self.size):
            count = start + len(block)
            yield start, block
        if self.count not in (None, count):
            raise ValueError(
                f"source must give the same points in every pass, but gave {self.count} and then {count}; "
                "pass a function that returns a fresh iterator."
            )
        self.count = count

    def _arrays(self) -> Iterator[Points]:
        """The arrays as they come, checked."""
        start = 0
        for number, given in enumerate(self._given()):
            name = f"block {number} of source, from point {start} on,"
            array = np.asarray(as_points(name, given, self.dimension, least=0))
            yield array
            start += len(array)

    def _given(self) -> Iterable[Any]:
        source = self.source
        if isinstance(source, np.ndarray):
            return (
                np.array(_fresh(source)[begin : begin + self.size])
                for begin in range(0, len(source), self.size)
            )
        return source() if callable(source) else source  # type: ignore[return-value]


def _mapped(path: str | os.PathLike[str]) -> np.ndarray:
    """The array of a file, not read yet."""
    try:
        with open(path, "rb") as file:
            np.lib.format.read_magic(file)
    except FileNotFoundError as error:
        raise FileNotFoundError(said_missing(path)) from error
    except OSError as error:
        raise OSError(f"source {os.fspath(path)} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        raise ValueError(
            f"source must be the path of a .npy file, but {os.fspath(path)} is none; save the points by "
            "np.save, or pass a function that returns an iterator of arrays."
        ) from error
    try:
        return np.load(path, mmap_mode="r")
    except (ValueError, EOFError) as error:
        raise ValueError(
            f"source cannot be mapped, for {os.fspath(path)} was cut short or holds no plain numbers; save "
            "the points by np.save again."
        ) from error


def _check_shape(source: np.ndarray, dimension: int) -> None:
    if source.ndim != 2 or source.shape[1] != dimension:
        raise ValueError(
            f"source must have the shape (points, {dimension}), but has {source.shape}; give one row per "
            "point."
        )


def _fresh(source: np.ndarray) -> np.ndarray:
    """The array; of a mapped file a new map, whose pages leave the memory of the process with it."""
    if isinstance(source, np.memmap) and isinstance(source.base, mmap.mmap) and source.filename:
        order = "C" if source.flags.c_contiguous else "F"
        return np.memmap(source.filename, source.dtype, "r", source.offset, source.shape, order)
    return source


def _cut(arrays: Iterator[Points], size: int) -> Iterator[tuple[int, Points]]:
    """The rows of arrays of any lengths in blocks of `size`, the last one shorter."""
    parts: list[Points] = []
    start = held = 0
    for array in arrays:
        while held + len(array) >= size:
            first, array = array[: size - held], array[size - held :]
            yield start, np.concatenate([*parts, first]) if parts else first
            start, parts, held = start + size, [], 0
        if len(array):
            parts, held = [*parts, array], held + len(array)
    if parts:
        yield start, np.concatenate(parts)
