"""`StoredFeet`: the feet of all points, and at the end the errors, in twelve bytes a point."""

import contextlib
import os
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._precision import working_dtype

STEPS = 2**48 - 1  # of a parameter's domain: 3.6e-15 of it each
HALF = 0xFFFF


class StoredFeet:
    """u, v and the error of every point, in an array (3, points) of 32-bit words.

    During the fit, parameters are fixed-point numbers of 48 bits: the upper 32 of u and of v in rows of their
    own, the lower 16 of both in the row of the errors, which nobody needs yet. At the end, `finish` replaces
    them, in place, by ordinary numbers in single precision. With `file` the array is mapped to a new `.npy`
    file.
    """

    def __init__(self, count: int, domain: Any, file: str | os.PathLike[str] | None):
        shape = (3, count)
        self.file = file
        self.rows: np.ndarray
        if file is None:
            self.rows = np.empty(shape, np.float32)
        else:
            try:
                self.rows = np.lib.format.open_memmap(file, "w+", np.float32, shape)
            except OSError as error:
                raise OSError(
                    f"feet_file {os.fspath(file)} cannot be written: {error.strerror or error}."
                ) from error
        self._words = self.rows.view(np.uint32)
        self._low, self._high = np.asarray(domain, np.float64).T[..., None]

    def read(self, start: int, count: int) -> Float[np.ndarray, "2 count"]:
        """(u, v) of points numbered from `start` on."""
        upper_u, upper_v, lower = self._words[:, start : start + count].astype(np.int64)
        steps = np.stack([upper_u << 16 | lower >> 16, upper_v << 16 | lower & HALF])
        found = self._low + steps / STEPS * (self._high - self._low)
        return np.minimum(found, self._high).astype(working_dtype())

    def write(self, start: int, u: Any, v: Any) -> None:
        """Replace those of the points from `start` on."""
        feet = np.stack([u, v]).astype(np.float64)
        share = (feet - self._low) / (self._high - self._low)
        steps = np.rint(np.clip(np.nan_to_num(share), 0.0, 1.0) * STEPS).astype(np.int64)
        lower = steps & HALF
        words = np.stack([*(steps >> 16), lower[0] << 16 | lower[1]])
        self._words[:, start : start + feet.shape[1]] = words

    def finish(self, start: int, u: Any, v: Any, errors: Any) -> None:
        """The last feet and the errors of the points from `start` on, which are not read again."""
        self.rows[:, start : start + len(u)] = np.stack([u, v, errors])

    def discard(self) -> None:
        """Remove the file: what a fit that ended early leaves in it are no feet."""
        if self.file is not None:
            with contextlib.suppress(OSError):
                os.unlink(self.file)
