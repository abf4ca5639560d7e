"""`fit_points` without a boundary: a sheet, a surface larger than it with a free border, and its loops."""

import dataclasses
from typing import Any

import jax
import numpy as np

from jaxfit._approximation._approximate import default_method, fit_cloud
from jaxfit._approximation._checked_scan import ScanInput
from jaxfit._approximation._growing_net import FIRST_SIZE, NetGrowth, fit_growing
from jaxfit._approximation._level_nets import FreeNets
from jaxfit._base import MOST_CONTROL_POINTS, default_size, free_base
from jaxfit._fit._border import FixedBorder, FreeBorder
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._result import Fit
from jaxfit._scan import Sheet, sheet_of, trim_loops

Order = tuple[int, int]


def fit_scan(
    scan: ScanInput,
    net: tuple[int, int] | None,
    order: Order,
    method: AbstractIterativeMethod | None,
    request: dict[str, Any],
    grows: bool,
) -> Fit:
    """The fit of the points on the sheet; all others get weight 0, and NaN where they are not finite."""
    points = scan.points
    sheet = sheet_of(points, scan.faces, scan.hole_length)
    finite = np.isfinite(points).all(axis=1)
    cloud, feet = points[finite], _feet(sheet, points, finite)
    weights = request["weights"]
    given = np.ones(len(points)) if weights is None else np.asarray(weights, float)
    counted = np.zeros(len(points))
    on_sheet = sheet.number[sheet.on_sheet]
    counted[on_sheet] = given[on_sheet]
    request = request | {"weights": counted[finite]}
    method = _with_free_border(default_method(method))
    nets = FreeNets(float(np.sqrt(sheet.sides[0] / sheet.sides[1])), order)
    if net is None and grows:
        base = _base(sheet, nets.net(FIRST_SIZE, MOST_CONTROL_POINTS), order)
        fit = fit_growing(NetGrowth(cloud, nets, method, request, feet), base)
    else:
        net = nets.net(default_size(len(on_sheet)), MOST_CONTROL_POINTS) if net is None else net
        fit = fit_cloud(cloud, _base(sheet, net, order), method, request | {"start": feet})
    return _with_loops(_for_all(fit, finite), sheet)


def _base(sheet: Sheet, net: tuple[int, int], order: Order) -> Any:
    some = np.flatnonzero(sheet.on_sheet)
    points = sheet.points[some] * sheet.size + sheet.centre
    return free_base(points, sheet.parameters[some], net, order)


def _feet(sheet: Sheet, points: np.ndarray, finite: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parameters of all finite points: those that were left out get their neighbours'."""
    from scipy.spatial import cKDTree

    found = np.full((len(points), 2), np.nan)
    found[sheet.number] = sheet.parameters
    rest = np.flatnonzero(finite & np.isnan(found[:, 0]))
    if len(rest):
        nearest = cKDTree(sheet.points).query((points[rest] - sheet.centre) / sheet.size)[1]
        found[rest] = sheet.parameters[nearest]
    return found[finite, 0], found[finite, 1]


def _with_free_border(method: Any) -> AbstractIterativeMethod:
    """There is no boundary that the default border could be held to."""
    if isinstance(getattr(method, "border", None), FixedBorder):
        return dataclasses.replace(method, border=FreeBorder())
    return method


def _for_all(fit: Fit, finite: np.ndarray) -> Fit:
    """With NaN for points that are not finite."""
    if finite.all():
        return fit
    arrays = {}
    for name in ("u", "v", "errors"):
        some = np.asarray(getattr(fit, name))
        arrays[name] = np.full(len(finite), np.nan, some.dtype)
        arrays[name][finite] = some
    return dataclasses.replace(fit, **jax.device_put(arrays))


def _with_loops(fit: Fit, sheet: Sheet) -> Fit:
    """With the rim and the holes in the parameters of its surface, and what was found on the way."""
    feet = np.stack([np.asarray(fit.u, float), np.asarray(fit.v, float)], axis=1)[sheet.number]
    loops = trim_loops(fit.surface, sheet, feet)
    domain = [tuple(float(x) for x in limits) for limits in fit.surface.domain]
    on_border = np.any([np.isin(x, limits) for x, limits in zip(feet.T, domain, strict=True)], axis=0)
    found = {
        **sheet.counts,
        "holes": len(loops) - 1,
        "hole_length": sheet.hole_length,
        "sheet_area": sheet.area,
        "feet_on_border": int((on_border & sheet.on_sheet).sum()),
        "loops": loops,
    }
    return dataclasses.replace(fit, stats=fit.stats | found)
