"""`Problem`: points, weights and tolerances in a unit of their own, padded to a common size."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int

from jaxfit._checks import is_concrete
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._scaling import Unit
from jaxfit._precision import bucket, working_dtype

MeshAxis = str | tuple[str, ...] | None


class Tolerances(eqx.Module):
    """The limits of a fit. Errors are fractions of the diagonal."""

    average: Float[Any, ""]
    maximum: Float[Any, ""]
    max_steps: Int[Any, ""]


class Problem(eqx.Module):
    """The points to fit. Lengths are in the unit of the problem, in which the diagonal is about 1.

    Attributes
    ----------
    target : array (d, points)
        The points, one coordinate after the other.
    weight : array (points,)
        0 for padding. Points of weight 0 have errors but no influence.
    real : array (points,) of bool
        False for padding.
    diagonal : array ()
        Of the bounding box of the points of positive weight.
    scale : array ()
        The unit of the problem, in the user's unit.
    tolerances : Tolerances
    axis : str or tuple of str, optional
        The axis of a mesh over which the points are divided among devices, each of which has a problem with
        its own ones (default None: this problem has all points).

    Examples
    --------
    The loop passes it to the functions of a method; `problem.counted` and `problem.total` follow from:

    >>> list(jf.Problem.__dataclass_fields__)
    ['target', 'weight', 'real', 'diagonal', 'scale', 'tolerances', 'axis']
    """

    target: Float[Any, "d points"]
    weight: Float[Any, " points"]
    real: Bool[Any, " points"]
    diagonal: Float[Any, ""]
    scale: Float[Any, ""]
    tolerances: Tolerances
    axis: MeshAxis = eqx.field(static=True, default=None)

    @property
    def devices(self) -> int:
        """Over how many devices the points are divided."""
        return 1 if self.axis is None else lax.axis_size(self.axis)

    def total(self, sums: Any) -> Any:
        """Sums over all points, of a tree with the sums over those of this device: one reduction for all."""
        if self.axis is None:
            return sums
        flat, restore = ravel_pytree(sums)
        return restore(lax.psum(flat, self.axis))

    def by_device(self, x: Float[Array, ""]) -> Float[Array, " devices"]:
        """What adds up to the numbers of all devices, where each has its own: so `total` brings maxima."""
        if self.axis is None:
            return x[None]
        return jnp.where(jnp.arange(self.devices) == lax.axis_index(self.axis), x, 0.0)

    @property
    def counted(self) -> Bool[Array, " points"]:
        """Points of positive weight."""
        return jnp.asarray(self.weight) > 0

    def ordered(self, order: Any) -> "Problem":
        """The problem with its points indexed by `order`."""
        xp: Any = np if is_concrete(self, order) else jnp
        parts = [xp.asarray(x)[..., order] for x in (self.target, self.weight, self.real)]
        return eqx.tree_at(lambda p: [p.target, p.weight, p.real], self, parts)

    def totals(
        self, projection: FootPoints, before: FootPoints
    ) -> tuple[Float[Array, "4"], Float[Array, ""]]:
        """Sums of errors, evaluations and changes over the points of positive weight, and their number; the
        greatest error.
        """
        change = jnp.abs(projection.u - before.u) + jnp.abs(projection.v - before.v)
        evaluations = projection.evaluations.astype(change.dtype)
        rows = jnp.stack([projection.error / self.diagonal, evaluations, change, jnp.ones_like(change)])
        rows = jnp.where(self.counted[None], rows, 0.0)
        return jnp.sum(rows, axis=1), jnp.max(rows[0])


def summary_of(totals: Float[Array, "4"], maximum: Float[Array, ""]) -> Float[Array, "4"]:
    """The summary of a projection, from `Problem.totals` over all points."""
    means = totals[:3] / totals[3]
    return jnp.concatenate([means[:1], maximum[None], means[1:]])


def make_problem(
    points: Any, weights: Any, unit: Unit, tolerances: Tolerances, padded: bool = True, axis: MeshAxis = None
) -> Problem:
    """The problem of `points`, `padded` to their bucket where they are concrete."""
    count, dtype = points.shape[0], working_dtype()
    concrete = is_concrete(points, weights)
    size = bucket(count) if concrete and padded else count
    inner = unit.inward(points)
    xp: Any = np if concrete else jnp  # NumPy's arrays cost no calls of their own
    if size > count:
        inner = np.concatenate([inner, np.repeat(inner[-1:], size - count, axis=0)])
    real = np.arange(size) < count
    weight = real if weights is None else xp.pad(xp.asarray(weights), (0, size - count))
    yp: Any = np if is_concrete(unit) else jnp
    return Problem(
        target=xp.asarray(inner.T, dtype),
        weight=xp.asarray(weight, dtype),
        real=real,
        diagonal=yp.asarray(unit.diagonal / unit.scale, dtype),
        scale=yp.asarray(unit.scale, dtype),
        tolerances=tolerances,
        axis=axis,
    )
