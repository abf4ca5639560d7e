r"""Robust losses: `Huber`, `Tukey` and `GemanMcClure`.

A fit with a loss minimises $\sum_k w_k\, c^2 \rho(|e_k|^2 / c^2)$, where least squares has
$\sum_k w_k |e_k|^2$. Its gradient is that of least squares with the weights $w_k \rho'(|e_k|^2 / c^2)$,
and so every method takes a loss by weighing its points anew in each iteration.
"""

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells import take
from jaxfit._checks import Scalar, check_kind, check_number, is_concrete
from jaxfit._fit._problem import Problem
from jaxfit._splines._pieces import Axis

# The scale follows from medians of neighbours: a median knows little of outliers among other points, and much
# of a place that a fit has not reached yet. A group is of so many points, or of two cells if that is more:
# points are sorted by cell, and in each of them outliers may come first.
TOGETHER, CELLS = 25, 2
# It is the median that this share of them do not exceed. With normally distributed residuals along a normal
# that is so many standard deviations, and so many more over the root of the number of points in a group.
SHARE, MEDIAN, SPREAD = 0.9, 0.6745, 1.05


class AbstractLoss(eqx.Module):
    """How much a distance counts. `scale` is a fraction of the diagonal."""

    scale: eqx.AbstractVar[Scalar | None]
    width: AbstractClassVar[float]  # the scale in standard deviations, where it follows from the errors

    def __check_init__(self) -> None:
        if self.scale is not None:
            check_number("scale", self.scale, 0.0)
            if is_concrete(self.scale) and not self.scale > 0:
                raise ValueError(
                    f"scale must be greater than 0, but is {self.scale!r}; pass a fraction of the diagonal, "
                    "or None."
                )

    @abstractmethod
    def cost(self, square: Array) -> Array:
        """rho(x) of squares of distances in units of the scale; rho(x) = x near 0."""

    @abstractmethod
    def derivative(self, square: Array) -> Array:
        """rho'(x), between 0 and 1."""

    def length(self, error: Any, real: Any, diagonal: Any, cells: Any) -> Float[Array, ""]:
        """The scale as a length; without one, from the errors of `real` points, sorted by cell."""
        error = jnp.asarray(error)
        if self.scale is not None:
            return jnp.asarray(self.scale, error.dtype) * diagonal
        least = jnp.finfo(error.dtype).eps * diagonal
        return jnp.maximum(self.width * _deviation(error, jnp.asarray(real), cells), least)


class Huber(AbstractLoss):
    r"""Distances beyond the scale c count $2 c |e| - c^2$: linearly, no more.

    The objective stays convex in the distances, and the influence of an outlier is bounded.

    Parameters
    ----------
    scale : float, optional
        c, as a fraction of the diagonal of the data's bounding box. By default 1.345 standard deviations,
        estimated anew in each iteration: the median distance of 25 neighbours or more that 90 % of such
        medians do not exceed. So outliers among other points change it little as long as they are a fifth or
        less; `StandardApproximation` and `GeometricApproximation` may follow so many all the same, since they
        come near to all points before the scale has fallen. Where there are more, pass a scale of a few times
        the noise; also where a feature takes up less than a tenth of a surface that is met elsewhere, or its
        points are taken for outliers.

    Raises
    ------
    ValueError
        If `scale` is not positive.

    Notes
    -----
    An estimated scale depends a little on the order of the points, which is another one inside `jit` than
    outside: nets of a noisy cloud differed by 2e-4 of the diagonal, and a derivative had another sign. Inside
    `jax.grad` or `jax.jit` pass a `scale`; fits then differ by rounding alone. This holds for all losses.

    P. J. Huber, Robust estimation of a location parameter, Ann. Math. Statist. 35, 1964.

    Examples
    --------
    Squared distances in units of the scale: small ones count in full, larger ones linearly in the distance.

    >>> loss, square = jf.Huber(), jnp.array([0.25, 4.0])
    >>> loss.cost(square).tolist(), loss.derivative(square).tolist()
    ([0.25, 3.0], [1.0, 0.5])
    """

    scale: Scalar | None = None
    width: ClassVar[float] = 1.345

    def cost(self, square: Array) -> Array:
        """x up to 1, then 2 sqrt(x) - 1."""
        return jnp.where(square <= 1, square, 2.0 * jnp.sqrt(jnp.maximum(square, 1.0)) - 1.0)

    def derivative(self, square: Array) -> Array:
        """1 up to 1, then 1 / sqrt(x)."""
        return 1.0 / jnp.sqrt(jnp.maximum(square, 1.0))


# The usual 4.685 suits normally distributed residuals. Those of a fit have long tails where detail is too
# fine for the net, and this detail would be lost.
TUKEY, GEMAN_MCCLURE = 14.0, 7.0


class Tukey(AbstractLoss):
    r"""Tukey's biweight: points farther than the scale c have no influence.

    $\rho(x) = (1 - (1 - x)^3) / 3$ up to 1. From a base surface far from the points, let the scale follow
    from the errors; otherwise no point may have influence.

    Parameters
    ----------
    scale : float, optional
        As for `Huber`, but by default 14 standard deviations.

    Notes
    -----
    A. E. Beaton and J. W. Tukey, Technometrics 16, 1974.

    Examples
    --------
    >>> jf.Tukey().derivative(jnp.array([0.0, 0.5, 4.0])).tolist()
    [1.0, 0.25, 0.0]
    """

    scale: Scalar | None = None
    width: ClassVar[float] = TUKEY

    def cost(self, square: Array) -> Array:
        """(1 - (1 - x)^3) / 3 up to 1, then 1/3."""
        return (1.0 - jnp.maximum(1.0 - square, 0.0) ** 3) / 3.0

    def derivative(self, square: Array) -> Array:
        """(1 - x)^2 up to 1, then 0."""
        return jnp.maximum(1.0 - square, 0.0) ** 2


class GemanMcClure(AbstractLoss):
    r"""$\rho(x) = x / (1 + x)$: the weight of far points falls with the fourth power of their distance.

    Parameters
    ----------
    scale : float, optional
        As for `Huber`, but by default 7 standard deviations.

    Notes
    -----
    S. Geman and D. E. McClure, Bull. Int. Statist. Inst. 52, 1987.

    Examples
    --------
    >>> jf.GemanMcClure().derivative(jnp.array([0.0, 1.0, 3.0])).tolist()
    [1.0, 0.25, 0.0625]
    """

    scale: Scalar | None = None
    width: ClassVar[float] = GEMAN_MCCLURE

    def cost(self, square: Array) -> Array:
        """x / (1 + x)."""
        return square / (1.0 + square)

    def derivative(self, square: Array) -> Array:
        """1 / (1 + x)^2."""
        return 1.0 / (1.0 + square) ** 2


def check_loss(loss: Any) -> None:
    """Raise unless `loss` is a loss, or None for least squares."""
    check_kind("loss", loss, AbstractLoss | None, "Huber(), Tukey() or GemanMcClure()")


def loss_length(loss: AbstractLoss | None, problem: Problem, axes: tuple[Axis, Axis], error: Any) -> Any:
    """The scale of a loss as a length, from the errors if it has none; None for least squares."""
    if loss is None:
        return None
    cells = [axis.ends[1] - axis.ends[0] + 1 for axis in axes]
    return loss.length(error, problem.counted, problem.diagonal, cells[0] * cells[1])


def _deviation(error: Array, real: Array, cells: Any) -> Float[Array, ""]:
    """The standard deviation of residuals where it is large. Points that are not `real` change nothing."""
    until = jnp.cumsum(real, dtype=jnp.int32)
    total, cells = until[error.shape[0] - 1], jnp.asarray(cells, jnp.int32)
    size = jnp.maximum(lax.div(CELLS * total + cells - 1, cells), TOGETHER)
    count = jnp.maximum(lax.div(total, size), 1)
    group = jnp.where(real, jnp.minimum(lax.div(until - 1, size), count - 1), error.shape[0])
    _, ordered = lax.sort((group, error), num_keys=2)
    number = jnp.arange(max(error.shape[0] // TOGETHER, 1), dtype=jnp.int32)
    start = number * size
    middle = (start + jnp.where(number == count - 1, total, start + size)) >> 1
    medians = jnp.where(number < count, take(ordered, jnp.minimum(middle, error.shape[0] - 1), 0), jnp.inf)
    usual = MEDIAN + SPREAD * lax.rsqrt(size.astype(error.dtype))
    return take(jnp.sort(medians), (SHARE * count.astype(error.dtype)).astype(jnp.int32), 0) / usual


def reweighted(loss: AbstractLoss | None, length: Any, weight: Any, error: Any) -> Any:
    """The weights of points at distances `error`, w rho'."""
    return weight if loss is None else weight * loss.derivative((error / length) ** 2)


class DataTerm(eqx.Module):
    """The data term of the objective, the sum of the weights, and the number of points that have any."""

    cost: Float[Array, ""]
    weight: Float[Array, ""]
    points: Float[Array, ""]

    @staticmethod
    def of(loss: AbstractLoss | None, length: Any, problem: Problem, error: Array) -> "DataTerm":
        """Of the points of this device."""
        cost = total_cost(loss, length, problem.weight, error)
        return DataTerm(cost, jnp.sum(problem.weight), jnp.sum(problem.counted, dtype=error.dtype))


def total_cost(loss: AbstractLoss | None, length: Any, weight: Any, error: Any) -> Float[Array, ""]:
    """The data term of the objective."""
    if loss is None:
        return jnp.sum(weight * error**2)
    return jnp.sum(weight * loss.cost((error / length) ** 2)) * length**2
