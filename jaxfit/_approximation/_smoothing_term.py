"""The smoothing term of the least-squares fits: a quadratic form, such as lambda times the thin plate."""

from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._checks import is_concrete
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import Stencil, ThinPlate, thin_plate


class Penalty(Protocol):
    """A smoothing term of an objective: a positive semidefinite quadratic form on nets."""

    def energy(self, net: Float[Array, "nu nv d"]) -> Float[Array, ""]:
        """The form at a net."""

    def gradient(self, net: Float[Array, "nu nv d"], stencil: Stencil) -> Float[Array, "nu nv d"]:
        """Half its gradient: the matrix times a net."""

    def stencil(self) -> Stencil:
        """Its matrix."""


class WeightedPlate(eqx.Module):
    """lambda times the thin plate."""

    plate: ThinPlate
    smoothing: Float[Any, ""]

    def energy(self, net: Float[Array, "nu nv d"]) -> Float[Array, ""]:
        """lambda F_s."""
        return self.smoothing * self.plate.energy(net)

    def gradient(self, net: Float[Array, "nu nv d"], stencil: Stencil) -> Float[Array, "nu nv d"]:
        """lambda A P, by way of the second derivatives, which loses no digits."""
        return self.smoothing * self.plate.adjoint(self.plate.residual(net))

    def stencil(self) -> Stencil:
        """lambda A."""
        return Stencil(self.smoothing * self.plate.stencil().entries)


def check_smoothing(smoothing: Any) -> None:
    """Raise unless lambda is a finite number of at least 0, or traced."""
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
            "lambda, for instance 2e-5."
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
