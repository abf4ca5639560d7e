"""An even choice among points: one from every cube of a lattice that has any."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int


def even_choice(points: Float[Any, "points 3"], most: int) -> Int[np.ndarray, " chosen"]:
    """Numbers of at most `most` points of a cloud of size one."""
    size = 1.0 / np.sqrt(most)
    while True:
        cell = np.floor(points / size).astype(int)
        _, first = np.unique(cell, axis=0, return_index=True)
        if len(first) <= most:
            return np.sort(first)
        size *= max(np.sqrt(len(first) / most), 1.02)
