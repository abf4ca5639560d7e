"""Checks of the arguments of `approximate` and `fit_points`."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxfit._approximation._errors import AbstractErrors
from jaxfit._checks import (
    as_floating,
    check_kind,
    check_number,
    check_progress,
    check_steps,
    check_switch,
    is_concrete,
)
from jaxfit._fit._adjoints import AbstractAdjoint
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._scaling import Unit, unit_of

METHODS = "OrthogonalDistance(), GeometricApproximation() or StandardApproximation()"
OUTSIDE = 1e-4  # of the domain: how far out a foot to start from may be


def checked_request(
    points: Array | np.ndarray,
    domain: Any = None,
    *,
    method: Any = None,
    tol_average: Any = 0.0,
    tol_maximum: Any = None,
    max_steps: Any = 0,
    weights: Any = None,
    start: Any = None,
    progress: Any = None,
    throw: Any = False,
    errors: Any = None,
    adjoint: Any = None,
) -> tuple[Unit, Any, Any]:
    """The unit, the weights and the first feet of a fit; raises if an argument is not valid.

    `domain` is that of the base surface, where there is one.
    """
    check_options(method, tol_average, tol_maximum, max_steps, progress, throw, errors, adjoint)
    count = points.shape[0]
    feet = None if start is None else checked_start(start, count, domain)
    weight = checked_weights(weights, count)
    return unit_of(_counted(points, weight)), weight, feet


def check_options(
    method: Any,
    tol_average: Any,
    tol_maximum: Any,
    max_steps: Any,
    progress: Any,
    throw: Any,
    errors: Any,
    adjoint: Any = None,
) -> None:
    """Raise unless the options of a fit are valid that say nothing about single points."""
    check_switch("throw", throw)
    check_progress(progress)
    if hasattr(method, "check_normals"):  # which only methods for grids have
        name = type(method).__name__
        raise TypeError(
            f"method must be one for clouds such as OrthogonalDistance(), but {name}() is one for grids; "
            "call interpolate."
        )
    check_kind("method", method, AbstractIterativeMethod | None, METHODS)
    check_kind("errors", errors, AbstractErrors | None, "GlobalFeet(), LocalFeet() or AtParameters()")
    check_kind("adjoint", adjoint, AbstractAdjoint | None, "ImplicitAdjoint() or UnrolledAdjoint()")
    check_steps("max_steps", max_steps)
    for name, tolerance in (("tol_average", tol_average), ("tol_maximum", tol_maximum)):
        if tolerance is not None and is_concrete(tolerance):
            check_number(name, tolerance, 0.0)
            if float(tolerance) > 1:
                raise ValueError(
                    f"{name} must be at most 1, but is {tolerance!r}; give a fraction of the diagonal, such "
                    "as 6e-4 for 0.06 %."
                )
    if tol_average is None and tol_maximum is None:
        raise ValueError(
            "tol_average and tol_maximum must not both be None, for every surface meets that; pass "
            "tol_average=0.0 to go on until the errors stop falling."
        )


def _counted(points: Any, weight: Any) -> Any:
    """The points of positive weight: only they determine the unit of the fit."""
    if weight is None:
        return points
    if is_concrete(points, weight):
        counted = np.asarray(weight) > 0
        some = np.asarray(points)[counted]
        # Those that all coincide give no unit.
        return points if counted.all() or not np.ptp(some, axis=0).any() else some
    # Of traced weights all points of weight 0 are taken to be where one that counts is.
    points, weight = jnp.asarray(points), jnp.asarray(weight)
    first = points[jnp.argmax(weight > 0)]
    return jnp.where((weight > 0)[:, None], points, first[None])


def checked_weights(weights: ArrayLike | None, count: int) -> Any:
    """One weight for each point, or None."""
    if weights is None:
        return None
    weight = as_floating("weights", weights, 1)
    if weight.shape[0] != count:
        raise ValueError(
            f"weights must hold one number for each of the {count} points, but has shape "
            f"{weight.shape}; give both the same length."
        )
    if is_concrete(weight):
        check_weight_range(np.asarray(weight).min(), np.asarray(weight).max())
    return weight


def check_weight_range(least: Any, most: Any) -> None:
    """Raise unless the least and the greatest weight are those of weights that a fit can have."""
    if least < 0 or not most > 0:
        raise ValueError(
            "weights must not be negative and not all zero; give each point a weight of 0 or more."
        )


def checked_start(start: Any, count: int, domain: Any) -> tuple[Any, Any]:
    """One foot for each point, within the domain if that is given."""
    if not isinstance(start, (tuple, list)) or len(start) != 2:
        raise ValueError("start must be a pair (u, v) of parameter arrays; pass start=(u, v).")
    u, v = (as_floating(f"start {name}", x, 1) for name, x in zip("uv", start, strict=True))
    if u.shape[0] != count or v.shape[0] != count:
        raise ValueError(
            f"start must hold a u and a v for each of the {count} points, but their shapes are "
            f"{u.shape} and {v.shape}; give one pair per point."
        )
    for name, x, limits in zip("uv", (u, v), domain or (), strict=False):
        if is_concrete(x, limits):
            check_start_range(name, np.asarray(x).min(), np.asarray(x).max(), limits)
    return u, v


def check_start_range(name: str, least: Any, most: Any, limits: Any) -> None:
    """Raise unless feet from `least` to `most` lie within the `limits` of the domain."""
    low, high = (float(y) for y in limits)
    slack = OUTSIDE * (high - low)
    if not (least >= low - slack and most <= high + slack):
        raise ValueError(
            f"start {name} must lie in the domain [{low:g}, {high:g}] of the base surface, but reaches "
            f"from {least:g} to {most:g}; give parameters on that surface."
        )
