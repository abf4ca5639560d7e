"""Which control points a fit holds."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxfit._checks import check_switches, is_concrete


class AbstractBorder(eqx.Module):
    """Which control points on the border of the net stay where they are."""

    @abstractmethod
    def held(self, ends_u: Any, ends_v: Any) -> Bool[Any, "nu nv"]:
        """The mask, from marks (2, nu) and (2, nv) of the first and last row and column of the net."""


class FixedBorder(AbstractBorder):
    """All control points on the border stay: the border curves of the base surface are kept.

    Section 2.3 of Kineri, Wang, Lin and Maekawa (2012). The default of the fits.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.StandardApproximation(border=jf.FixedBorder()).border
    FixedBorder()
    """

    def held(self, ends_u: Any, ends_v: Any) -> Bool[Any, "nu nv"]:
        """The whole border."""
        return (ends_u[0] | ends_u[1])[:, None] | (ends_v[0] | ends_v[1])[None, :]


class FixedCorners(AbstractBorder):
    """Only the four corners stay, and the border curves are fitted.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.OrthogonalDistance(border=jf.FixedCorners()).border
    FixedCorners()
    """

    def held(self, ends_u: Any, ends_v: Any) -> Bool[Any, "nu nv"]:
        """The corners."""
        return (ends_u[0] | ends_u[1])[:, None] & (ends_v[0] | ends_v[1])[None, :]


class FreeBorder(AbstractBorder):
    """No control point stays: an ordinary least-squares fit.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.StandardApproximation(border=jf.FreeBorder()).border
    FreeBorder()
    """

    def held(self, ends_u: Any, ends_v: Any) -> Bool[Any, "nu nv"]:
        """None."""
        return (ends_u[0] & False)[:, None] & ends_v[0][None, :]


class FixedSides(AbstractBorder):
    """Some sides stay, the other ones are fitted.

    Parameters
    ----------
    u0, u1, v0, v1 : bool
        Whether the side u = 0, u = 1, v = 0 or v = 1 stays, its corners included (default False).

    Raises
    ------
    TypeError
        If one of them is neither True nor False.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.FixedSides(u0=True, v1=True).u0
    True
    """

    u0: bool = False
    u1: bool = False
    v0: bool = False
    v1: bool = False

    def __check_init__(self) -> None:
        check_switches(self, ("u0", "u1", "v0", "v1"))

    def held(self, ends_u: Any, ends_v: Any) -> Bool[Any, "nu nv"]:
        """The sides that were named."""
        along_u = (ends_u[0] & self.u0) | (ends_u[1] & self.u1)
        return along_u[:, None] | ((ends_v[0] & self.v0) | (ends_v[1] & self.v1))[None, :]


def held_points(border: AbstractBorder, shape: tuple[int, ...], used: Any) -> Bool[Any, "nu nv"]:
    """The control points that `border` holds, and surplus ones; `used` (2,) are those in use.

    Examples
    --------
    >>> jf.held_points(jf.FixedCorners(), (3, 3), np.array([3, 3])).astype(int).tolist()
    [[1, 0, 1], [0, 0, 0], [1, 0, 1]]
    """
    xp: Any = np if is_concrete(used) else jnp
    number = [xp.arange(n) for n in shape[:2]]
    ends = [xp.stack([n == 0, n == used[k] - 1]) for k, n in enumerate(number)]
    surplus = (number[0] >= used[0])[:, None] | (number[1] >= used[1])[None, :]
    return border.held(*ends) | surplus


def corners(nu: int, nv: int) -> Bool[np.ndarray, "nu nv"]:
    """The four corners of a net."""
    return held_points(FixedCorners(), (nu, nv), np.asarray([nu, nv]))
