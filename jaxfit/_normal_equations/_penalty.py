"""`AbstractPenalty`: the smoothing term of an objective, a quadratic form on nets."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jax import Array
from jaxtyping import Float

from jaxfit._normal_equations._stencil import Stencil
from jaxfit._normal_equations._thin_plate import ThinPlate


class AbstractPenalty(eqx.Module):
    """A positive semidefinite quadratic form."""

    @abstractmethod
    def energy(self, net: Float[Array, "nu nv d"]) -> Float[Array, ""]:
        """The form at a net."""

    @abstractmethod
    def system(self, net: Float[Array, "nu nv d"]) -> tuple[Stencil, Float[Array, "nu nv d"]]:
        """Its matrix, and this matrix times a net, half the gradient there."""


class WeightedPlate(AbstractPenalty):
    """lambda times the thin plate."""

    plate: ThinPlate
    smoothing: Float[Any, ""]

    def energy(self, net: Float[Array, "nu nv d"]) -> Float[Array, ""]:
        """lambda F_s."""
        return self.smoothing * self.plate.energy(net)

    def system(self, net: Float[Array, "nu nv d"]) -> tuple[Stencil, Float[Array, "nu nv d"]]:
        """lambda A, and lambda A P by way of the second derivatives, which loses no digits."""
        image = self.smoothing * self.plate.adjoint(self.plate.residual(net))
        return Stencil(self.smoothing * self.plate.stencil().entries), image
