"""`fit_points`: a base surface from the boundary of a cloud, then a fit."""

import inspect
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from jaxfit._approximation._approximate import approximate, default_method
from jaxfit._approximation._checked_arguments import checked_request
from jaxfit._approximation._cloud_fit import LEAST_POINTS, without_derivatives
from jaxfit._approximation._growing_net import FIRST_SIZE, NetGrowth, fit_growing
from jaxfit._approximation._growing_net import LEAST_POINTS as LEAST_POINTS_TO_GROW
from jaxfit._base import AbstractBaseMethod, Boundary, Coons, base_surface, default_base, default_net
from jaxfit._checks import as_points, check_kind, check_order, eager_where_concrete, is_concrete
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._result import Fit


@eager_where_concrete
def fit_points(
    points: ArrayLike,
    boundary: Boundary | None = None,
    net: tuple[int, int] | None = None,
    order: tuple[int, int] = (4, 4),
    method: AbstractIterativeMethod | None = None,
    base: Coons | AbstractBaseMethod | None = None,
    **options: Any,
) -> Fit:
    """Fit a surface to a cloud of points with four boundary polylines: `base_surface`, then `approximate`.

    Parameters
    ----------
    points : array (points, d)
    boundary : Boundary
        The four sides of the patch.
    net : (nu, nv), optional
        Control points along u and v, shared between the directions by the lengths of the sides if not given.
        Default: the net grows, see Notes. Where it cannot, for fewer than 500 points, a method with an
        `insertion` of its own, a `start` or no tolerance: about one control point for every eight points,
        at least twice the order and at most 64 each way.
    order : (K, L)
        Degree + 1 along u and v (default (4, 4)).
    base : Coons(), Meshless() or DynamicBaseSurface(), optional
        How the base surface is made. Default: Coons(), or where that is farther than 0.5 % of the diagonal
        from the points on average, Meshless(), if it is nearer.
    method, options
        As for `approximate`: tol_average, tol_maximum, max_steps, weights, start, progress, throw, errors,
        adjoint.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        As `base_surface` and `approximate` do, and if there is no boundary.
    TypeError
        If there is no such option, points are traced by `jit` or `vmap`, or the boundary by these or `grad`;
        or if the fit is differentiated without a `net`.

    Notes
    -----
    Without a `net` a coarse one is fitted to nine in ten of the points and then made up to 1.5 times finer
    each way, again and again, each fit starting from the one before. That ends where the tolerances are met.
    It also ends where the tenth of the points that was held out comes no nearer to the surface, by 2 % of its
    average error, as the net gets finer: what is left is noise, and the net before is taken. And it ends
    with three points for a control point. The last fit is one to all points. Each net takes at most
    20 iterations, the last up to `max_steps` where the tolerances can be met. Of more than 20,000 points as
    many as the net needs, 48 for a control point, choose it.

    With a `net` the fit is differentiable in points, weights and numbers of the method, as `approximate` is.
    The base surface counts as constant then: inside, where it starts from does not matter to where the fit
    comes to rest. Blend curves by `coons_surface` for derivatives with respect to the border.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 10), np.linspace(0, 1, 6), indexing="ij")
    >>> grid = np.stack([x, y, x * y], axis=2)
    >>> fit = jf.fit_points(grid.reshape(-1, 3), jf.Boundary.from_grid(grid), net=(6, 5), max_steps=3)
    >>> bool(fit.converged), bool(fit.average_error < 6e-4)
    (True, True)
    """
    _check_names(options)
    check_order(order)
    if boundary is None:
        raise ValueError(
            "boundary must be given for scattered points; pass boundary=Boundary(v0, v1, u0, u1), the "
            "four polylines around the patch."
        )
    check_kind("boundary", boundary, Boundary, "Boundary(v0, v1, u0, u1)")
    cloud = as_points("points", points, boundary.v0.shape[1], least=LEAST_POINTS)
    fixed, known = without_derivatives((cloud, options))
    checked_request(fixed, method=without_derivatives(method), **known)
    if net is None and _may_grow(fixed, method, known):
        _check_no_derivative(cloud, method, options)
        request = _DEFAULTS | options
        growth = NetGrowth(np.asarray(cloud), boundary, order, default_method(method), request)
        return fit_growing(growth, _base(boundary, cloud, growth.net(FIRST_SIZE), order, base))
    net = default_net(cloud.shape[0], boundary, order) if net is None else net
    return approximate(cloud, _base(boundary, fixed, net, order, base), method, **options)


def _check_no_derivative(cloud: Any, method: Any, options: dict[str, Any]) -> None:
    if options.get("adjoint") is not None or not is_concrete(cloud, method, options):
        raise TypeError(
            "net must be given where a fit is differentiated, since a net that grows depends on the points "
            "by jumps; pass for instance net=(20, 20)."
        )


def _base(boundary: Boundary, cloud: Any, net: tuple[int, int], order: tuple[int, int], base: Any) -> Any:
    if base is None and is_concrete(cloud):
        return default_base(boundary, np.asarray(cloud), net, order)
    return base_surface(boundary, cloud, net=net, order=order, method=base)


def _may_grow(cloud: Any, method: Any, options: dict[str, Any]) -> bool:
    """Whether points can be held out of the fit, and nothing asks for one net."""
    goals = [options.get(name, _DEFAULTS[name]) for name in ("tol_average", "tol_maximum")]
    return (
        is_concrete(cloud, options)
        and len(cloud) >= LEAST_POINTS_TO_GROW
        and getattr(method, "insertion", None) is None
        and options.get("start") is None
        and any(goal is not None for goal in goals)
        and options.get("max_steps") != 0
    )


_DEFAULTS = {
    name: parameter.default
    for name, parameter in inspect.signature(approximate).parameters.items()
    if name not in ("points", "base", "method")
}


def _check_names(options: dict[str, Any]) -> None:
    for name in options:
        if name not in _DEFAULTS:
            raise TypeError(f"{name} is not an option of fit_points; pass any of {', '.join(_DEFAULTS)}.")
