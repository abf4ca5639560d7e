"""Arrays from NumPy's files, which may be damaged or claim more than they hold."""

import math
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from jaxfit.io._point_data import InputError

_LARGEST_RATIO = 1100  # by which deflating can shrink
_DAMAGED = (
    ValueError,
    EOFError,
    KeyError,
    RuntimeError,  # a compression that is not supported, for one
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


def load_arrays(path: Path, names: Sequence[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Those arrays of an .npz file that are among `names` (an .npy file's only one as 'array'), and the names
    of all. Nothing larger than the file can hold is allocated.

    Raises
    ------
    InputError
        If the file cannot be read, is damaged, or holds something else than arrays of numbers there.
    """
    try:
        with open(path, "rb") as file:
            if file.read(len(npy.MAGIC_PREFIX)) == npy.MAGIC_PREFIX:
                file.seek(0)
                return {"array": _array(file, path.stat().st_size)}, ["one array without a name"]
        return _members(path, names)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    except MemoryError as error:
        raise InputError(f"{path} holds more than there is memory for; thin the points.") from error
    except _DAMAGED as error:
        raise InputError(
            f"{path} is damaged, or holds something else than plain NumPy arrays of numbers; "
            "write it again with NumPy."
        ) from error


def _members(path: Path, names: Sequence[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    found = {}
    with zipfile.ZipFile(path) as archive:
        inside = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        for name in inside.keys() & set(names):  # others may hold anything, so they are not read
            entry = inside[name]
            if entry.file_size > _LARGEST_RATIO * min(entry.compress_size, path.stat().st_size):
                raise ValueError("more is claimed than can be in it")
            with archive.open(entry) as member:
                found[name] = _array(member, entry.file_size)
    return found, list(inside)


def _array(file: Any, size: int) -> np.ndarray:
    """The array in a stream of `size` bytes, once its header is no larger than that."""
    start = file.tell()
    version: Any = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject or min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > size - file.tell():
        raise ValueError("no plain array, or not all of it")
    file.seek(start)
    array = npy.read_array(file, allow_pickle=False)
    return array.astype(dtype.newbyteorder("="), copy=False)  # JAX takes no other order of bytes
