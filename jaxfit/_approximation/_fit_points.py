"""`fit_points`: a base surface from the boundary of a cloud, then a fit."""

import dataclasses
import inspect
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from jaxfit._approximation._approximate import approximate, default_method
from jaxfit._approximation._checked_arguments import checked_request
from jaxfit._approximation._checked_scan import checked_scan
from jaxfit._approximation._cloud_fit import LEAST_POINTS
from jaxfit._approximation._fit_on_grown_net import fit_on_grown_net
from jaxfit._approximation._fit_without_boundary import fit_without_boundary
from jaxfit._approximation._growing_net import LEAST_POINTS as LEAST_POINTS_TO_GROW
from jaxfit._approximation._growing_net import NetGrowth
from jaxfit._approximation._level_nets import BoundaryNets
from jaxfit._approximation._programs_ahead import programs_of_cloud_ahead
from jaxfit._base import (
    AbstractBaseMethod,
    Boundary,
    Coons,
    base_surface,
    check_concrete,
    check_net_of_cloud,
    check_same_place,
    checked_boundary,
    checked_net_shape,
    default_base,
    default_net,
    far_sides,
)
from jaxfit._checks import (
    as_points,
    check_kind,
    checked_order,
    eager_where_concrete,
    is_concrete,
    with_whole_steps,
    without_derivatives,
)
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._result import Fit, converged_or_raise
from jaxfit._progress_line import doing, shows_progress
from jaxfit._scan import check_measured


@shows_progress("fitting a cloud")
@eager_where_concrete
def fit_points(
    points: Any,
    boundary: Boundary | None = None,
    net: tuple[int, int] | None = None,
    order: int | tuple[int, int] = (4, 4),
    method: AbstractIterativeMethod | None = None,
    base: Coons | AbstractBaseMethod | None = None,
    faces: ArrayLike | None = None,
    hole_length: float | None = None,
    **options: Any,
) -> Fit:
    """Fit a surface to a cloud of points: with four boundary polylines, or a raw scan.

    With a boundary: `base_surface`, then `approximate`. Without one the points are cleaned and connected by a
    mesh, whose rim and holes become loops in (u, v). The surface is larger than the sheet, by half a span
    of its knots on each side, and smooth where there are no points.

    Parameters
    ----------
    points : array (points, d); (points, 3) without a boundary
        In any order and any unit. Without a boundary they may hold duplicates, outliers and NaN. Or what
        `jaxfit.io.read_points` has read, whose boundary and faces are taken where none are given.
    boundary : Boundary, optional
        The four sides of the patch.
    net : (nu, nv), optional
        Control points along u and v, at most 16 for each point or 4,096 in all, if that is more. Shared
        between the directions by the lengths of the sides if not given.
        Default: the net grows, see Notes. Where it cannot, for fewer than 500 points, a method with an
        `insertion` of its own or a `start`: about one control point for every eight points,
        at least twice the order and at most 64 each way.
    order : (K, L) or int
        Degree + 1 along u and v (default (4, 4)), each 2 to 8; one number is that of both.
    method : GeometricApproximation(), OrthogonalDistance(), StandardApproximation() or your own, optional
        As for `approximate`.
    base : Coons(), Meshless() or DynamicBaseSurface(), optional
        How the base surface is made. Default: Coons(), or where that is farther than 0.5 % of the diagonal
        from the points on average, Meshless(), if it is nearer. Only with a boundary.
    faces : array (faces, 3) of int, optional
        The triangles of the file that the points come from, as numbers of points. Only without a boundary.
        Default: the points are connected by their neighbours.
    hole_length : float, optional
        In the unit of the points: no triangle is longer, so gaps that are wider are holes. Only without a
        boundary. Default: twice the distance of the sixth neighbour, of 99 % of the points; given faces are
        all kept.
    options
        As for `approximate`: tol_average (default 6e-4) and tol_maximum (default none), fractions of the
        diagonal: 6e-4 is 0.06 %; max_steps, weights, start, progress, throw, errors, adjoint. Without a
        boundary there are no `start` and no `adjoint`.

    Returns
    -------
    Fit
        Where the net has grown, `stats` also hold `growth_steps`: iterations with all nets before the last
        fit. With a boundary, outside `jit` and `vmap`, they hold `far_sides`: sides that are far from all
        points, each with its distance as a fraction of the diagonal. Without a boundary they hold
        `points_read` and of these the number of `non_finite`, `nodata`, `duplicates` and `outliers`, and
        those `off_the_sheet`; `holes`, the `hole_length` in force, `feet_on_border`: points on the sheet
        whose foot is on the border of the domain; and `sheet_area`, that of the mesh, near which
        `trimmed.area()` is. Its vertices are moved along their normals to the mean with their neighbours
        first, for noise makes a mesh rough and its area too large. `counted` says which points are on the
        sheet. `trimmed` is the surface cut to the sheet, a `TrimmedSurface`. Points that were left out have
        errors as well, but do not count; where they are not finite u, v and errors are NaN. A coordinate that
        stands for no data (nines such as -9999, the ends of 16 bits, beyond 1e20) makes a point `nodata`,
        which counts as not finite, if it is far from all others.

    Raises
    ------
    ValueError
        As `base_surface` and `approximate` do; for a net too large. Without a boundary also if the points
        make no sheet: a disc, with or without holes.
    TypeError
        If there is no such option, points are traced by `jit` or `vmap`, or the boundary by these or `grad`;
        or if the fit is differentiated without a `net` or without a boundary.
    ImportError
        Without a boundary, if shapely (the extra `scan`) is not installed.

    Notes
    -----
    Knots are placed by how the sides bend. For knots of your own give them to a base surface with as many
    control points, `BSplineSurface(base.control_points, knots_u, knots_v)`, and call `approximate` with a
    method whose border is `FreeBorder()`: with other knots the sides are no longer those of the boundary.

    Without a `net` a coarse one is fitted to nine in ten of the points, fine enough for the sides to come
    within 0.5 % of the diagonal. It is made up to 1.44 times finer each way, again and again, each fit
    starting from the one before. A fit that is hardly nearer to the points than the surface that `Meshless`
    makes of them has come to rest on wrong waves, and starts anew from that. Growth ends where the tolerances
    are met; without a `tol_maximum` finer nets are tried, too, while a whole patch (by the median of nine
    points whose feet are neighbours) is ten times `tol_average` away, as long as they bring it a fifth
    nearer (`tol_maximum=1.0` asks for the average alone). Growth also ends where the tenth of the points
    that was held out comes no nearer to the surface as the net gets finer, by 1.5 % of its average error, or
    by 0.3 % while errors of neighbours correlate by 0.05 or more: what is left is noise, and the net before
    is taken. Where they correlate by 0.5 or more, four finer nets are tried first. And it ends with two
    points for a control point, without a boundary three; or with 200 control points each way, without a
    boundary 96. With a boundary the net that this ends with is also fitted from a base surface of its own, as
    if it had been given: that fit is taken if it meets the tolerances as well, has no more folds and less
    curvature energy (9), for what coarser nets cannot follow bends parameter lines. The last fit is one to
    all points. Each net takes at most 20 iterations, the last up to `max_steps` where the tolerances can be
    met. Of more than 20,000 points every second, third and so on choose it: 10,000 to 20,000 of them, or for
    finer nets at least 12 for each control point.

    Without a boundary each point has its Delaunay star in its own tangent plane, and triangles on which
    stars agree make the mesh. It is laid out flat with little distortion and no flipped triangle (symmetric
    Dirichlet energy), and the smallest rectangle around it becomes the domain. The base surface is a thin
    plate at these parameters with a free border, and a border held by the method stays where the plate put
    it, beyond the points. Clouds that are level, but too rough for neighbours to agree on a surface, as a
    survey of a town from the air, are laid out by their principal plane instead, the mesh over medians of
    their heights. Others whose noise is comparable to the distances between points are meshed from a quarter
    of them or fewer, moved onto planes through many neighbours. Without a `tol_maximum` the last fit goes on
    until no point is farther than ten times `tol_average`, if it comes to that. Fails where two sheets are
    nearer to each other than their points or their noise, for closed surfaces, tubes and several pieces. Of
    more than 30,000 points an even choice makes the mesh; given faces then say which of these are neighbours,
    by distances along their edges.

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

    Without the boundary:

    >>> x, y = np.meshgrid(np.linspace(0, 1, 16), np.linspace(0, 1, 12), indexing="ij")
    >>> fit = jf.fit_points(np.stack([x, y, x * y], axis=2).reshape(-1, 3), net=(8, 7))
    >>> bool(fit.average_error < 6e-4), fit.stats["outliers"], len(fit.trimmed.loops)
    (True, 0, 1)
    """
    _check_names(options)
    order = checked_order(order)
    if hasattr(points, "cloud"):
        points, boundary, faces = _parts(points, boundary, faces)
    if boundary is None and not isinstance(points, Boundary):
        return _without_boundary(points, faces, hole_length, net, order, method, base, options)
    boundary = checked_boundary(boundary, points)
    check_concrete(boundary)
    check_kind("base", base, (Coons, AbstractBaseMethod, type(None)), "Coons() or Meshless()")
    for name, value in (("faces", faces), ("hole_length", hole_length)):
        if value is not None:
            raise ValueError(
                f"{name} must be None where there is a boundary, which says where the patch ends; leave out "
                "either."
            )
    cloud = as_points("points", points, boundary.v0.shape[1], least=LEAST_POINTS)
    options = with_whole_steps(options)
    fixed, known = without_derivatives((cloud, options))
    if not is_concrete(fixed):
        raise TypeError(
            "points must be concrete, but are traced; call fit_points outside jit and vmap, or make a base "
            "surface outside and call approximate(points, base) inside."
        )
    checked_request(fixed, method=without_derivatives(method), **known)
    check_measured("points", np.asarray(fixed), "leave them out, or the boundary, for a raw scan is cleaned")
    check_same_place(np.asarray(fixed), boundary)
    if net is None and _may_grow(fixed, method, known):
        _check_no_derivative(cloud, method, options)
        request = _DEFAULTS | options | {"throw": False}
        nets = BoundaryNets(boundary, order, np.asarray(cloud), base)
        growth = NetGrowth(nets.points, nets, default_method(method), request)
        growth.compile_ahead()
        doing("making a base surface")
        fit = fit_on_grown_net(growth)
    else:
        net = default_net(cloud.shape[0], boundary, order) if net is None else checked_net_shape(net, order)
        check_net_of_cloud(net, cloud.shape[0])
        values, implicit = without_derivatives(method), not is_concrete(cloud, method, options)
        if is_concrete(values, known):
            request = _DEFAULTS | known
            programs_of_cloud_ahead(default_method(values), fixed, net, order, request, None, implicit)
        begun = _base(boundary, fixed, net, order, base)
        fit = approximate(cloud, begun, method, **(options | {"throw": False}))
    if is_concrete(known):
        far = _far_sides(fixed, boundary, _DEFAULTS | known)
        fit = dataclasses.replace(fit, stats=fit.stats | {"far_sides": far})
    return converged_or_raise(fit) if options.get("throw", False) else fit


def _far_sides(cloud: Any, boundary: Boundary, request: dict[str, Any]) -> dict[str, float]:
    """Sides that are far from the points that count."""
    weights, goals = request["weights"], (request["tol_average"], request["tol_maximum"])
    some = np.asarray(cloud, float)[slice(None) if weights is None else np.asarray(weights) > 0]
    return far_sides(some, boundary, min(float(x) for x in goals if x is not None))


def _check_no_derivative(cloud: Any, method: Any, options: dict[str, Any]) -> None:
    if options.get("adjoint") is not None or not is_concrete(cloud, method, options):
        raise TypeError(
            "net must be given where a fit is differentiated, since a net that grows depends on the points "
            "by jumps; pass for instance net=(20, 20)."
        )


def _parts(data: Any, boundary: Any, faces: Any) -> tuple[Any, Any, Any]:
    """Points, boundary and faces of a file, these two where there are no others."""
    boundary = data.boundary if boundary is None else boundary
    return data.cloud, boundary, data.faces if faces is None and boundary is None else faces


def _base(
    boundary: Boundary,
    cloud: Any,
    net: tuple[int, int],
    order: tuple[int, int],
    base: Any,
) -> Any:
    if base is None and is_concrete(cloud):
        doing("making a base surface")
        return default_base(boundary, np.asarray(cloud), net, order)
    return base_surface(boundary, cloud, net=net, order=order, method=base)


def _without_boundary(
    points: Any,
    faces: Any,
    hole_length: Any,
    net: Any,
    order: tuple[int, int],
    method: Any,
    base: Any,
    options: dict[str, Any],
) -> Fit:
    if options.get("adjoint") is not None or not is_concrete(method, options):
        raise TypeError(
            "boundary must be given where a fit is differentiated or traced, since the sheet of a raw scan "
            "depends on the points by jumps; pass a boundary and a net."
        )
    scan = checked_scan(points, faces, hole_length, base, options.get("start"))
    finite = np.isfinite(scan.points).all(axis=1)
    if finite.any():  # or else `fit_without_boundary` says what is wrong
        whole = np.where(finite[:, None], scan.points, scan.points[np.argmax(finite)])
        checked_request(whole, method=method, **options)
    if net is not None:
        net = checked_net_shape(net, order)
        check_net_of_cloud(net, int(finite.sum()))
    grows = net is None and _may_grow(scan.points[finite], method, options)
    return fit_without_boundary(scan, net, order, method, _DEFAULTS | options, grows)


def _may_grow(cloud: Any, method: Any, options: dict[str, Any]) -> bool:
    """Whether points can be held out of the fit, and nothing asks for one net."""
    if not is_concrete(cloud, options):
        return False
    weights = options.get("weights")
    counted = len(cloud) if weights is None else int(np.count_nonzero(np.asarray(weights) > 0))
    return (
        counted >= LEAST_POINTS_TO_GROW
        and getattr(method, "insertion", None) is None
        and options.get("start") is None
        and options.get("max_steps") != 0
    )


_DEFAULTS = {
    name: parameter.default
    for name, parameter in inspect.signature(approximate).parameters.items()
    if name not in ("points", "base", "method")
}


def _check_names(options: dict[str, Any]) -> None:
    for name in options:
        if name in ("degree", "degrees"):
            raise TypeError(f"{name} is not an option of fit_points; pass order, degree + 1 along u and v.")
        if name not in _DEFAULTS:
            own = list(inspect.signature(fit_points).parameters)[1:-1]
            names = ", ".join([*own, *_DEFAULTS])
            raise TypeError(f"{name} is not an option of fit_points; pass any of {names}.")
