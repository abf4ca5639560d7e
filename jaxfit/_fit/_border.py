"""`FixedBorder`, `FixedCorners`, `FreeBorder`, `FixedSides`: which control points do not move."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxfit._checks import check_kind, check_switches, is_concrete


class AbstractBorder(eqx.Module):
    """Which control points on the border of the net do not move."""

    @abstractmethod
    def held(self, ends_u: Any, ends_v: Any) -> Bool[Any, "nu nv"]:
        """The mask of control points that do not move.

        `ends_u` (2, nu) and `ends_v` (2, nv) are True at the first and the last row and column of the net.
        """


class FixedBorder(AbstractBorder):
    """No control point on the border moves: the border curves of the base surface are kept.

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
    """Only the four corners do not move; the border curves are fitted.

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
    """All control points move: an ordinary least-squares fit.

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
    """Some sides do not move; the other ones are fitted.

    Parameters
    ----------
    u0, u1, v0, v1 : bool
        Whether the side u = 0, u = 1, v = 0 or v = 1 is fixed, its corners included (default False).

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
        """The chosen sides."""
        along_u = (ends_u[0] & self.u0) | (ends_u[1] & self.u1)
        return along_u[:, None] | ((ends_v[0] & self.v0) | (ends_v[1] & self.v1))[None, :]


def check_border(border: Any) -> None:
    """Raise unless `border` is one."""
    names = "FixedBorder(), FixedCorners(), FixedSides(u0=True) or FreeBorder()"
    check_kind("border", border, AbstractBorder, names)


def held_points(border: AbstractBorder, shape: tuple[int, ...], used: Any) -> Bool[Any, "nu nv"]:
    """The control points that do not move: those that `border` holds, and surplus ones.

    Parameters
    ----------
    border : FixedBorder(), FixedCorners(), FixedSides(...) or FreeBorder()
    shape : tuple of int
        Begins with (nu, nv).
    used : array (2,) of int
        How many control points along u and v are in use; those after them are surplus.

    Returns
    -------
    array (nu, nv) of bool

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
