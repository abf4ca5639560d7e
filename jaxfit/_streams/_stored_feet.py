"""`StoredFeet`: the feet of all points, and at the end the errors, in twelve bytes a point."""

import os
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._precision import working_dtype

STEPS = 2**32 - 1  # of a parameter's domain: 2.3e-10 of it each


class StoredFeet:
    """u, v and the error of every point, in an array (3, points) of 32-bit words.

    During the fit, parameters are fixed-point numbers, which are 250 times as fine as numbers of single
    precision next to 1. At the end, `finish` replaces them, in place, by ordinary numbers in single
    precision. With `file` the array is mapped to a new `.npy` file.
    """

    def __init__(self, count: int, domain: Any, file: str | os.PathLike[str] | None):
        shape = (3, count)
        self.rows: np.ndarray
        if file is None:
            self.rows = np.empty(shape, np.float32)
        else:
            self.rows = np.lib.format.open_memmap(file, "w+", np.float32, shape)
        self._fixed = self.rows[:2].view(np.uint32)
        self._low, self._high = np.asarray(domain, np.float64).T[..., None]

    def read(self, start: int, count: int) -> Float[np.ndarray, "2 count"]:
        """(u, v) of points numbered from `start` on."""
        share = self._fixed[:, start : start + count].astype(np.float64) / STEPS
        found = self._low + share * (self._high - self._low)
        return np.minimum(found, self._high).astype(working_dtype())

    def write(self, start: int, u: Any, v: Any) -> None:
        """Replace those of the points from `start` on."""
        feet = np.stack([u, v]).astype(np.float64)
        share = (feet - self._low) / (self._high - self._low)
        share = np.clip(np.nan_to_num(share), 0.0, 1.0)
        self._fixed[:, start : start + feet.shape[1]] = np.rint(share * STEPS).astype(np.uint32)

    def finish(self, start: int, u: Any, v: Any, errors: Any) -> None:
        """The last feet and the errors of the points from `start` on, which are not read again."""
        self.rows[:, start : start + len(u)] = np.stack([u, v, errors])
