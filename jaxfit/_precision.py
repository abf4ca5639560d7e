"""What a tolerance asks of the working precision, said once."""

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit._checks import is_concrete

# Relative to the extent of the data: what feet reach without trouble in each precision.
DEFAULT_FOOT_TOLERANCE = {"float64": 1e-12, "float32": 1e-5}
# The same, for the errors of an interpolation.
DEFAULT_INTERPOLATION_TOLERANCE = {"float64": 1e-12, "float32": 2e-6}
# Where rounding alone costs more than this, a fit that asks for nothing has not converged either.
WORST_TOLERANCE = 1e-3
_advised = False


def working_dtype() -> np.dtype:
    """What everything is fitted in, whatever the data's own type: float64 if the session has that."""
    return np.dtype(jnp.result_type(float))


def default_foot_tolerance(dtype: np.dtype) -> float:
    """Tolerance for foot points, as a fraction of the extent."""
    return DEFAULT_FOOT_TOLERANCE.get(np.dtype(dtype).name, 1e-5)


def interpolation_tolerance(tolerance: Any, dtype: np.dtype, least: Any) -> tuple[Any, Any]:
    """What an interpolation is to reach, and what it may have after its net is rounded.

    The second is the tolerance asked for, with advice where this precision cannot meet it; by default the
    usual one, or the `least` that the data permits where that is more, within reason. The first leaves room
    for rounding.
    """
    xp: Any = np if is_concrete(tolerance, least) else jnp
    if tolerance is None:
        usual = DEFAULT_INTERPOLATION_TOLERANCE.get(np.dtype(dtype).name, 2e-6)
        tolerance = xp.minimum(xp.maximum(usual, least), WORST_TOLERANCE)
    elif is_concrete(tolerance):
        advise_x64(float(tolerance), np.dtype(dtype), stacklevel=6)
    return xp.maximum(tolerance - least / 8, 0.5 * tolerance), tolerance


def advise_x64(tolerance: float, dtype: np.dtype, stacklevel: int = 4) -> None:
    """Tell the user, once a session, that a tolerance is out of reach in this precision."""
    global _advised
    if _advised or np.dtype(dtype).itemsize >= 8 or tolerance >= 1e-6:
        return
    _advised = True
    warnings.warn(
        f"the tolerance {tolerance:g} is beyond {np.dtype(dtype).name}; switch on "
        "double precision, the flag jax_enable_x64 of jax.config.",
        stacklevel=stacklevel,
    )


def bucket(count: int, least: int = 64) -> int:
    """The next of four sizes an octave, so that nearby sizes share one compilation."""
    count = max(count, least)
    step = 1 << max(count.bit_length() - 3, 0)
    return -(-count // step) * step
