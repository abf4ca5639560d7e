"""`Coons`, and the abstract class of the methods that make the inside of a base surface."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jaxtyping import Float

from jaxfit._base._coons import GREVILLE, AbstractAbscissae
from jaxfit._base._host_splines import Knots
from jaxfit._base._normalised_cloud import Cloud
from jaxfit._checks import check_kind


class AbstractBaseMethod(eqx.Module):
    """A way from the Coons surface of a boundary, and a cloud, to a base surface."""

    @abstractmethod
    def fill(
        self, net: Float[Any, "nu nv d"], knots: Knots, order: tuple[int, int], cloud: Cloud
    ) -> Float[Any, "nu nv d"]:
        """The net with its inside moved towards the cloud, all in the cloud's frame of size one."""

    @abstractmethod
    def check_dimension(self, dimension: int) -> None:
        """Raise ValueError where the method cannot work in a space of this dimension."""


class Coons(eqx.Module):
    """The Coons surface of the boundary itself, equations (6)-(7); it does not use the points.

    Parameters
    ----------
    abscissae : Greville() or Uniform()
        Default `Greville()`; see `coons_surface`.

    Raises
    ------
    TypeError
        If `abscissae` is neither.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5), indexing="ij")
    >>> boundary = jf.Boundary.from_grid(np.stack([x, y, x * y], axis=2))
    >>> x, y, z = jf.base_surface(boundary, net=(4, 4), method=jf.Coons())(0.5, 0.5).tolist()
    >>> abs(z - x * y) < 0.01
    True
    """

    abscissae: AbstractAbscissae = GREVILLE

    def __check_init__(self) -> None:
        check_kind("abscissae", self.abscissae, AbstractAbscissae, "Greville()")
