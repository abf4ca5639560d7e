"""Sparse systems of SciPy's whose factors need no pivots off the diagonal."""

from typing import Any

import numpy as np


def solved_on_diagonal(system: Any, right: np.ndarray) -> np.ndarray:
    """The solution of a system that is positive definite, or an M-matrix: pivots off the diagonal would only
    add fill, which may cost twenty times as much.
    """
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    factors = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return factors.solve(right)
