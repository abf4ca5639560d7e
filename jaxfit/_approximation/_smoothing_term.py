"""The smoothing term of the least-squares fits: the thin plate, and lambda, its weight."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfit._checks import is_concrete
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import ThinPlate, thin_plate


def check_smoothing(smoothing: Any, rules: str) -> None:
    """Raise unless lambda is a finite number of at least 0, or traced; `rules` are what may stand for it."""
    if not is_concrete(smoothing):
        return
    try:
        value = np.asarray(
            np.nan if isinstance(smoothing, bool | np.bool_ | str | bytes) else smoothing, np.float64
        )
    except (TypeError, ValueError):
        value = np.asarray(np.nan)
    if value.ndim or not 0 <= value < np.inf:
        raise ValueError(
            f"smoothing must be a finite number of at least 0, but is {smoothing!r}; pass "
            f"lambda, for instance 2e-5, or {rules}."
        )


def constant_plate(insertion: Any, surface: WorkingSurface) -> ThinPlate | None:
    """The thin plate of a surface that keeps its knots: computed once, not in every iteration."""
    return thin_plate(*surface.axes) if insertion is None else None


def plate_of(constant: ThinPlate | None, surface: WorkingSurface) -> ThinPlate:
    """The thin plate of a surface, the `constant` one if there is one."""
    return thin_plate(*surface.axes) if constant is None else constant


def as_smoothing(smoothing: Any, dtype: Any) -> Any:
    """lambda as an array. A traced one that is negative or not finite becomes NaN, and the fit diverges."""
    if is_concrete(smoothing):
        return np.asarray(smoothing, dtype)
    value = jnp.asarray(smoothing, dtype)
    return jnp.where(jnp.isfinite(value) & (value >= 0), value, jnp.nan)
