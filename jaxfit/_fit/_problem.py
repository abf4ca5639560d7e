"""A fitting problem in its own unit: centred, the diagonal near 1, padded to a common size."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._checks import check_resolution, is_concrete
from jaxfit._precision import bucket, working_dtype
from jaxfit._splines import BSplineSurface
from jaxfit._splines._pieces import Axis, make_axis


class Problem(eqx.Module):
    """Points to fit, and what stays fixed while the net moves. Lengths in units of `scale`."""

    target: Float[Any, "d points"]
    weight: Float[Any, " points"]
    axis_u: Axis
    axis_v: Axis
    padding: Float[Any, " points"]  # 1 for a point, 0 for what only fills up the size
    diagonal: Float[Any, ""]
    foot_tolerance: Float[Any, ""]
    lowest: Float[Any, ""] | None = None  # eigenvalue of a grid's collocation matrix, where a method asks
    smoothing: Float[Any, ""] | None = None  # weight of the thin plate, likewise

    def ordered(self, order: Any) -> "Problem":
        """The same with its points in another order."""
        xp: Any = np if is_concrete(self, order) else jnp
        parts = [xp.asarray(x)[..., order] for x in (self.target, self.weight, self.padding)]
        return eqx.tree_at(lambda p: [p.target, p.weight, p.padding], self, parts)

    def smoothed(self, smoothing: Any) -> "Problem":
        """The same with a thin plate of this weight."""
        xp: Any = np if is_concrete(smoothing) else jnp
        value = xp.asarray(smoothing, self.target.dtype)
        return eqx.tree_at(lambda p: p.smoothing, self, value, is_leaf=lambda x: x is None)

    def summarise(self, measured: Any, before: Any) -> tuple[Array, Array, Array, Array]:
        """Of the true points: average and maximum error as fractions of the diagonal, then averages of the
        evaluations for a foot and of its change of parameters.
        """
        change = jnp.abs(measured.u - before.u) + jnp.abs(measured.v - before.v)
        evaluations = measured.steps.astype(change.dtype)
        rows = jnp.stack([measured.error / self.diagonal, evaluations, change])
        rows = jnp.where((self.padding > 0)[None], rows, 0.0)
        average, evaluations, change = jnp.sum(rows, axis=1) / jnp.sum(self.padding)
        return average, jnp.max(rows[0]), evaluations, change


def check_smoothing(smoothing: Any) -> None:
    """Lambda is a finite number of at least 0, unless it is traced."""
    if not is_concrete(smoothing):
        return
    try:
        value = np.asarray(np.nan if isinstance(smoothing, (bool, np.bool_, str)) else smoothing, np.float64)
    except (TypeError, ValueError):
        value = np.asarray(np.nan)
    if value.ndim or not 0 <= value < np.inf:
        raise ValueError(
            f"smoothing must be a finite number of at least 0, but is {smoothing!r}; pass "
            "lambda, for instance 2e-5."
        )


class Unit(eqx.Module):
    """The change of unit x -> (x - centre) / scale. The scale is a power of two, so it rounds nothing."""

    centre: Any
    scale: Any
    diagonal: Any  # of the data's bounding box, in the user's unit

    def inward(self, x: Any) -> Any:
        """Into the problem's unit. Concrete data is centred in double precision whatever the session's."""
        if is_concrete(x, self.centre):
            return (np.asarray(x, np.float64) - self.centre) / self.scale
        return (x - _like(self.centre, x)) / self.scale

    def outward(self, x: Any) -> Any:
        """A net or grid, back into the user's unit."""
        if is_concrete(x, self.centre):
            return np.asarray(x, np.float64) * self.scale + self.centre
        return self.within(x.dtype)(x)

    def within(self, dtype: Any) -> "Outward":
        """The way out for compiled code in `dtype`, though the session may have no double precision."""
        if not is_concrete(self.centre):
            one = jnp.ones((), dtype)
            return Outward((self.scale, one), self.centre.astype(dtype), jnp.zeros_like(self.centre, dtype))
        high = np.asarray(self.centre, dtype)
        half = 2.0 ** (round(np.log2(self.scale)) // 2)
        factors = np.asarray(half, dtype), np.asarray(self.scale / half, dtype)
        return Outward(factors, high, np.asarray(self.centre - high, dtype))

    def loss(self, points: Any) -> Any:
        """At most how far rounding has moved `points`, a net (nu, nv, d) in the user's unit, as a fraction of
        the diagonal: by so much errors on a surface with these control points may be larger.
        """
        xp: Any = np if is_concrete(points) else jnp
        reach = xp.maximum(xp.max(points), -xp.min(points))
        return rounding_loss(points, reach / self.diagonal)

    def least_tolerance(self, dtype: Any) -> Any:
        """About what rounding to `dtype` far from the origin costs, as a fraction of the diagonal."""
        xp: Any = np if is_concrete(self.centre, self.diagonal) else jnp
        reach = xp.max(xp.abs(self.centre)) + self.diagonal
        return 8.0 * np.finfo(dtype).eps * reach / self.diagonal


def rounding_loss(net: Any, reach: Any) -> Any:
    """What rounding costs a net (nu, nv, d) whose largest coordinate is `reach`, in diagonals."""
    share = 0.5 * np.finfo(net.dtype).eps * float(np.sqrt(net.shape[2]))
    return (share * reach).astype(net.dtype)


class Outward(eqx.Module):
    """The change of unit back to the user's, in one precision.

    The scale is a product of two numbers, for it may be beyond the range of this precision where the data is
    not. The centre is a sum of two: with the smaller added first, the sum is rounded but once.
    """

    factors: tuple[Float[Any, ""], Float[Any, ""]]
    high: Float[Any, " d"]
    low: Float[Any, " d"]

    def __call__(self, x: Float[Array, "n m d"]) -> Float[Array, "n m d"]:
        """Out of the problem's unit."""
        return (x * self.factors[0] * self.factors[1] + self.low[None, None]) + self.high[None, None]

    def loss(self, net: Float[Array, "n m d"], diagonal: Array) -> Float[Array, ""]:
        """`Unit.loss` of a net in the user's unit, the diagonal being in the problem's."""
        reach = jnp.max(jnp.abs(net)) / self.factors[0] / self.factors[1]
        return rounding_loss(net, reach / diagonal)


def _like(centre: Any, x: Any) -> Any:
    return jnp.asarray(centre, x.dtype).reshape((1,) * (x.ndim - 1) + (-1,))


def unit_of(points: Any, name: str = "points") -> Unit:
    """The unit of a cloud (points, d): the middle of its box, and about its diagonal.

    Raises ValueError, naming the argument, if all points coincide or are out of range.
    """
    if is_concrete(points):
        points = np.asarray(points, np.float64)
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
        check_resolution(name, low, high, diagonal)
        info = np.finfo(working_dtype())
        if diagonal < info.tiny / info.eps or max(-low.min(), high.max()) > info.max:
            raise ValueError(
                f"{name} must keep to the range of {info.dtype} in size, but the bounding box has the "
                f"diagonal {diagonal:.3g}; choose another unit of length."
            )
        return Unit(0.5 * (low + high), 2.0 ** round(np.log2(diagonal)), diagonal)
    low, high = jnp.min(points, axis=0), jnp.max(points, axis=0)
    diagonal = jnp.linalg.norm(high - low)
    scale = jnp.where(diagonal > 0, jnp.exp2(jnp.round(jnp.log2(diagonal))), 1.0)
    return Unit(0.5 * (low + high), scale, diagonal)


def axes_of(surface: BSplineSurface, dtype: Any) -> tuple[Axis, Axis]:
    """Both directions of a surface's knots."""
    knots = (surface.knots_u, surface.knots_v)
    axes = [make_axis(x.astype(dtype), order) for x, order in zip(knots, surface.order, strict=True)]
    return axes[0], axes[1]


def axes_of_averages(knots: tuple[Any, Any], order: tuple[int, int]) -> tuple[Axis, Axis]:
    """Both directions of a grid's averaged knots (5), which never repeat inside."""
    return make_axis(knots[0], order[0], simple=True), make_axis(knots[1], order[1], simple=True)


def make_problem(
    points: Any,
    weights: Any,
    axes: tuple[Axis, Axis],
    unit: Unit,
    foot_tolerance: float,
) -> Problem:
    """Points in the problem's unit, padded to their bucket where they are concrete."""
    concrete = is_concrete(points, weights)
    count = points.shape[0]
    dtype = working_dtype()
    inner = unit.inward(points)
    size = bucket(count) if concrete else count
    xp: Any = np if concrete else jnp  # NumPy's arrays cost no calls of their own
    if size > count:
        inner = np.concatenate([inner, np.repeat(inner[-1:], size - count, axis=0)])
    real = (np.arange(size) < count).astype(dtype)
    weight = real if weights is None else xp.pad(xp.asarray(weights), (0, size - count))
    return Problem(
        target=xp.asarray(inner.T, dtype),
        weight=xp.asarray(weight, dtype),
        axis_u=axes[0],
        axis_v=axes[1],
        padding=np.asarray(real, dtype),
        diagonal=xp.asarray(unit.diagonal / unit.scale, dtype),
        foot_tolerance=np.asarray(foot_tolerance, dtype),
    )


def padded_start(x: Any, size: int, dtype: Any) -> Any:
    """Starting parameters, repeated at the end up to the size of the problem."""
    xp: Any = np if is_concrete(x) else jnp
    x = xp.asarray(x, dtype)
    return xp.concatenate([x, xp.repeat(x[-1:], size - x.shape[0])])


def order_by_cell(axes: tuple[Axis, Axis], u: Any, v: Any, count: int) -> Any:
    """An order of points, `count` true ones first, in which those of one cell come together: neighbours in
    memory are then neighbours on the surface, and laying points out in rows is quicker.
    """
    xp: Any = np if is_concrete(axes, u, v) else jnp
    cells = axes[0].cells * axes[1].cells
    padding = np.arange(u.shape[0]) >= count
    cell = xp.where(padding, cells, axes[0].locate(u) * axes[1].cells + axes[1].locate(v))
    # Numbers of 16 bits are what NumPy sorts in linear time.
    return xp.argsort(cell.astype(np.uint16) if cells < 1 << 16 else cell, stable=True)
