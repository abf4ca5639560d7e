"""`Problem`: points, weights and tolerances in a unit of their own, padded to a common size."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._checks import is_concrete
from jaxfit._fit._projection import Projection
from jaxfit._fit._scaling import Unit
from jaxfit._precision import bucket, working_dtype


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

    Examples
    --------
    The loop passes it to the functions of a method; `problem.counted` and `problem.summarise` follow from:

    >>> list(jf.Problem.__dataclass_fields__)
    ['target', 'weight', 'real', 'diagonal', 'scale', 'tolerances']
    """

    target: Float[Any, "d points"]
    weight: Float[Any, " points"]
    real: Bool[Any, " points"]
    diagonal: Float[Any, ""]
    scale: Float[Any, ""]
    tolerances: Tolerances

    @property
    def counted(self) -> Bool[Array, " points"]:
        """Points of positive weight."""
        return jnp.asarray(self.weight) > 0

    def ordered(self, order: Any) -> "Problem":
        """The problem with its points indexed by `order`."""
        xp: Any = np if is_concrete(self, order) else jnp
        parts = [xp.asarray(x)[..., order] for x in (self.target, self.weight, self.real)]
        return eqx.tree_at(lambda p: [p.target, p.weight, p.real], self, parts)

    def summarise(self, projection: Projection, before: Projection) -> Float[Array, "4"]:
        """Average and maximum error as fractions of the diagonal, and the average evaluations and changes.

        The last two are per foot: evaluations of the surface, and change of the parameters u plus v.
        """
        sums, maximum = self.totals(projection, before)
        average, evaluations, change = sums / jnp.sum(self.counted)
        return jnp.stack([average, maximum, evaluations, change])

    def totals(
        self, projection: Projection, before: Projection
    ) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """Sums of errors, evaluations and changes over the points of positive weight; the greatest error."""
        change = jnp.abs(projection.u - before.u) + jnp.abs(projection.v - before.v)
        evaluations = projection.evaluations.astype(change.dtype)
        rows = jnp.stack([projection.error / self.diagonal, evaluations, change])
        rows = jnp.where(self.counted[None], rows, 0.0)
        return jnp.sum(rows, axis=1), jnp.max(rows[0])


def make_problem(
    points: Any, weights: Any, unit: Unit, tolerances: Tolerances, padded: bool = True
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
    )
