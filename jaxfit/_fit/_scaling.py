"""`Unit`: the change of unit after which the data is centred and its diagonal is about 1."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfit._checks import check_resolution, is_concrete
from jaxfit._precision import working_dtype


class Unit(eqx.Module):
    """The change of unit x -> (x - centre) / scale. The scale is a power of two, so it rounds nothing."""

    centre: Any
    scale: Any
    diagonal: Any  # of the data's bounding box, in the user's unit

    def inward(self, x: Any) -> Any:
        """Into the problem's unit. Concrete data is always centred in double precision."""
        if is_concrete(x, self.centre):
            return (np.asarray(x, np.float64) - self.centre) / self.scale
        return (x - _like(self.centre, x)) / self.scale

    def outward(self, x: Any) -> Any:
        """A net or grid, back into the user's unit."""
        if is_concrete(x, self.centre):
            return np.asarray(x, np.float64) * self.scale + self.centre
        return self.within(x.dtype)(x)

    def within(self, dtype: Any) -> "Outward":
        """The inverse for compiled code in `dtype`, accurate without double precision."""
        if not is_concrete(self.centre):
            one = jnp.ones((), dtype)
            return Outward((self.scale, one), self.centre.astype(dtype), jnp.zeros_like(self.centre, dtype))
        high = np.asarray(self.centre, dtype)
        half = 2.0 ** (round(np.log2(self.scale)) // 2)
        factors = np.asarray(half, dtype), np.asarray(self.scale / half, dtype)
        return Outward(factors, high, np.asarray(self.centre - high, dtype))

    def loss(self, points: Any) -> Any:
        """A bound on the rounding of a net (nu, nv, d) in the user's unit, as a fraction of the diagonal.

        Errors of a surface with these control points may be larger by so much.
        """
        xp: Any = np if is_concrete(points) else jnp
        reach = xp.maximum(xp.max(points), -xp.min(points))
        return rounding_loss(points, reach / self.diagonal)

    def least_tolerance(self, dtype: Any) -> Any:
        """The error of rounding to `dtype`, as a fraction of the diagonal: large far from the origin."""
        xp: Any = np if is_concrete(self.centre, self.diagonal) else jnp
        reach = xp.max(xp.abs(self.centre)) + self.diagonal
        return 8.0 * np.finfo(dtype).eps * reach / self.diagonal


def rounding_loss(net: Any, reach: Any) -> Any:
    """A bound on the rounding of a net (nu, nv, d) whose largest coordinate is `reach` diagonals."""
    share = 0.5 * np.finfo(net.dtype).eps * float(np.sqrt(net.shape[2]))
    return (share * reach).astype(net.dtype)


class Outward(eqx.Module):
    """The change of unit back to the user's, in one precision.

    The scale is a product of two numbers, since it may exceed the range of this precision. The centre is a
    sum of two, and the smaller is added first, so that the result is rounded once.
    """

    factors: tuple[Float[Any, ""], Float[Any, ""]]
    high: Float[Any, " d"]
    low: Float[Any, " d"]

    def __call__(self, x: Float[Any, "n m d"]) -> Float[Any, "n m d"]:
        """Out of the problem's unit."""
        return (x * self.factors[0] * self.factors[1] + self.low[None, None]) + self.high[None, None]

    def loss(self, net: Float[Any, "n m d"], diagonal: Any) -> Float[Any, ""]:
        """`Unit.loss` of a net in the user's unit, the diagonal being in the problem's."""
        xp: Any = np if is_concrete(net) else jnp
        reach = xp.max(xp.abs(net)) / self.factors[0] / self.factors[1]
        return rounding_loss(net, reach / diagonal)


def _like(centre: Any, x: Any) -> Any:
    return jnp.asarray(centre, jax.dtypes.canonicalize_dtype(x.dtype)).reshape((1,) * (x.ndim - 1) + (-1,))


def unit_of(points: Any, name: str = "points") -> Unit:
    """The unit of a cloud (points, d): the middle of its box, and about its diagonal.

    Raises ValueError, naming the argument, if all points coincide or are out of range.
    """
    if is_concrete(points):
        given, points = np.asarray(points).dtype, np.asarray(points, np.float64)
        # Along rows of memory: across them NumPy takes ten times as long.
        columns = np.ascontiguousarray(points.T)
        low, high = columns.min(axis=1), columns.max(axis=1)
        side = float(np.max(high - low))
        # Unit-free: squares of very small or very large numbers would leave the number range.
        diagonal = side * float(np.linalg.norm((high - low) / side)) if side > 0 else 0.0
        if not np.isfinite(diagonal):
            raise ValueError(
                f"{name} must have differences within the range of float64, but their bounding box has none; "
                "scale them down."
            )
        if not diagonal > 0:
            raise ValueError(
                f"{name} must not all coincide, but their bounding box has no extent; give distinct points."
            )
        info = np.finfo(working_dtype())
        if diagonal < info.tiny / info.eps or max(-low.min(), high.max()) > info.max:
            raise ValueError(
                f"{name} must keep to the range of {info.dtype} in size, but the bounding box has the "
                f"diagonal {diagonal:.3g}; choose another unit of length."
            )
        check_resolution(name, low, high, diagonal, given)
        return Unit(0.5 * (low + high), 2.0 ** round(np.log2(diagonal)), diagonal)
    low, high = jnp.min(points, axis=0), jnp.max(points, axis=0)
    diagonal = jnp.linalg.norm(high - low)
    scale = jnp.where(diagonal > 0, jnp.exp2(jnp.round(jnp.log2(diagonal))), 1.0)
    return Unit(0.5 * (low + high), scale, diagonal)
