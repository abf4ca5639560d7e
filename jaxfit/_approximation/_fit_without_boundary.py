"""`fit_points` without a boundary: a sheet, a surface larger than it with a free border, and its loops."""

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np

from jaxfit._approximation._approximate import default_method
from jaxfit._approximation._checked_scan import ScanInput
from jaxfit._approximation._cloud_fit import fit_cloud
from jaxfit._approximation._errors import GlobalFeet, LocalFeet
from jaxfit._approximation._fit_on_grown_net import fit_everywhere, fit_on_grown_net
from jaxfit._approximation._growing_net import NetGrowth
from jaxfit._approximation._level_nets import SheetNets
from jaxfit._base import MOST_CONTROL_POINTS, default_size
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._result import Fit
from jaxfit._scan import Layout, Sheet, node_feet, sheet_of, trim_loops
from jaxfit._trimmed import TrimmedSurface

Order = tuple[int, int]


def fit_without_boundary(
    scan: ScanInput,
    net: tuple[int, int] | None,
    order: Order,
    method: AbstractIterativeMethod | None,
    request: dict[str, Any],
    grows: bool,
) -> Fit:
    """The fit of the points on the sheet; all others get weight 0, and NaN where they are not finite."""
    points = scan.points
    finite = np.isfinite(points).all(axis=1)
    given = np.ones(len(points)) if request["weights"] is None else np.asarray(request["weights"], float)
    sheet = sheet_of(points, scan.faces, scan.hole_length, given > 0)
    weights = np.zeros(len(points))
    on_sheet = sheet.number[sheet.on_sheet]
    weights[on_sheet] = given[on_sheet]
    measured = request["errors"]
    # Loops need feet on the own side of a thin part, which the nearest ones may not be.
    request = request | {"weights": weights[finite], "errors": measured or LocalFeet()}
    cloud, nets, method = points[finite], SheetNets(sheet, order), default_method(method)
    if net is None and grows:
        growth = NetGrowth(cloud, nets, method, request, cleaned=True)
        fit = fit_on_grown_net(growth)
        net = fit.surface.shape
    else:
        net = nets.net(default_size(len(on_sheet)), MOST_CONTROL_POINTS) if net is None else net
        fit = fit_everywhere(
            partial(fit_cloud, cloud, nets.base(net), method), request | {"start": nets.feet(net)}
        )
    # Duplicates add nothing to the fit, but are on the sheet as well.
    same = (points[sheet.number[sheet.nearest]] == cloud).all(axis=1) & sheet.on_sheet[sheet.nearest]
    counted = finite.copy()
    counted[finite] = same & (given[finite] > 0)
    counts = sheet.counts | {"nodata": scan.nodata, "non_finite": sheet.counts["non_finite"] - scan.nodata}
    fit = dataclasses.replace(fit, stats=fit.stats | counts | {"counted": counted})
    fit = _with_loops(fit, finite, sheet, sheet.layout(net, order))
    if measured is None:
        fit = _at_nearest_feet(fit, cloud, weights[finite] > 0)
    return _for_all(fit, finite)


def _at_nearest_feet(fit: Fit, cloud: np.ndarray, counted: np.ndarray) -> Fit:
    """With errors at the nearest feet on the whole surface."""
    diagonal = fit.stats["diagonal"]
    known = fit.u, fit.v, np.asarray(fit.errors) * diagonal, np.ones(len(cloud), bool)
    u, v, distance, _ = GlobalFeet().feet(fit.surface, cloud, known, at_feet=True)
    dtype = np.asarray(fit.errors).dtype
    errors = np.asarray(distance, dtype) / diagonal
    arrays = {
        "u": np.asarray(u, dtype),
        "v": np.asarray(v, dtype),
        "errors": errors,
        "average_error": errors[counted].mean(dtype=dtype),
        "maximum_error": errors[counted].max(),
    }
    return dataclasses.replace(fit, **jax.device_put(arrays))


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


def _with_loops(fit: Fit, finite: np.ndarray, sheet: Sheet, layout: Layout) -> Fit:
    """With the rim and the holes in the parameters of its surface, and what was found on the way."""
    number = (np.cumsum(finite) - 1)[sheet.number]
    feet = np.stack([np.asarray(fit.u, float), np.asarray(fit.v, float)], axis=1)[number]
    nodes = node_feet(fit.surface, sheet, feet)
    loops = trim_loops(fit.surface, sheet, layout.sides, nodes, feet)
    domain = [tuple(float(x) for x in limits) for limits in fit.surface.domain]
    on_border = np.any([np.isin(x, limits) for x, limits in zip(feet.T, domain, strict=True)], axis=0)
    found = {
        "holes": len(loops) - 1,
        "hole_length": sheet.hole_length,
        "sheet_area": sheet.area,
        "feet_on_border": int((on_border & sheet.on_sheet).sum()),
    }
    return dataclasses.replace(fit, stats=fit.stats | found, trimmed=TrimmedSurface(fit.surface, loops))
