"""`fit_points`: a base surface from the boundary of a cloud, then a fit."""

import inspect
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from jaxfit._approximation._approximate import LEAST_POINTS, approximate
from jaxfit._approximation._checked_arguments import checked_request
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
        Control points along u and v. Default: about one for every eight points, shared between the
        directions by the lengths of the sides, at least twice the order and at most 64 each.
    order : (K, L)
        Degree + 1 along u and v (default (4, 4)).
    base : Coons(), Meshless() or DynamicBaseSurface(), optional
        How the base surface is made. Default: Coons(), or where that is farther than 0.5 % of the diagonal
        from the points on average, Meshless(), if it is nearer.
    method, options
        As for `approximate`: tol_average, tol_maximum, max_steps, weights, start, progress, throw, errors.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        As `base_surface` and `approximate` do, and if there is no boundary.
    TypeError
        If there is no such option, or points or boundary are traced by `jit`, `vmap` or `grad`.

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
    checked_request(cloud, method=method, **options)
    net = default_net(cloud.shape[0], boundary, order) if net is None else net
    if base is None and is_concrete(cloud):
        begun = default_base(boundary, np.asarray(cloud), net, order)
    else:
        begun = base_surface(boundary, cloud, net=net, order=order, method=base)
    return approximate(cloud, begun, method, **options)


def _check_names(options: dict[str, Any]) -> None:
    known = list(inspect.signature(approximate).parameters)[3:]  # behind points, base and method
    for name in options:
        if name not in known:
            raise TypeError(f"{name} is not an option of fit_points; pass any of {', '.join(known)}.")
