"""Fits of all points of a cloud with the net that has been chosen by part of them."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from jaxfit._approximation._growing_net import GROWTH, LEVEL_STEPS, NetGrowth, far_from
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._result import Fit, converged_or_raise
from jaxfit._splines import BSplineSurface

EXTENSIONS = 3  # most nets tried with all points where the chosen one misses the tolerances


def fit_everywhere(fit: Callable[[dict[str, Any]], Fit], request: dict[str, Any]) -> Fit:
    """The fit to a cleaned cloud. Without a tolerance for the maximum it goes on until that is FAR times the
    one for the average, if it comes to that; the average alone decides whether it has converged.
    """
    average, throw = request["tol_average"], request["throw"]
    if average is None or request["tol_maximum"] is not None:
        return fit(request)
    found = fit(request | {"tol_maximum": far_from(average), "throw": False})
    found = dataclasses.replace(found, stats=found.stats | {"tol_maximum": np.inf})  # as it was asked for
    ended = found.result in (RESULTS.stalled, RESULTS.max_steps_reached)
    if ended and float(found.average_error) <= average:
        found = dataclasses.replace(found, result=RESULTS.converged)
    return converged_or_raise(found) if throw else found


def fit_on_grown_net(growth: NetGrowth) -> Fit:
    """The fit with a net of the size that the tolerances take, or that the points allow."""
    level, why = growth.grown()
    level = growth.afresh(level)
    size, request = level.size, growth.request | {"throw": False}
    if why != RESULTS.converged:
        request["max_steps"] = min(LEVEL_STEPS, request["max_steps"])
    request["start"] = growth.nets.feet(growth.net(size))
    fit = _of_all_points(growth, size, level.fit.surface, request)
    for _ in range(EXTENSIONS if why == RESULTS.converged else 0):
        size *= GROWTH
        if bool(fit.converged) or not growth.allows(size):
            break
        net = growth.net(size)
        if net == fit.surface.shape:
            break
        request["start"] = growth.nets.feet(net)
        fit = _of_all_points(growth, size, growth.nets.carried(fit.surface, net), request)
    if fit.result in (RESULTS.stalled, RESULTS.max_steps_reached) and why != RESULTS.converged:
        fit = dataclasses.replace(fit, result=why)
    before = growth.steps - int(fit.stats["num_steps"])
    fit = dataclasses.replace(fit, stats=fit.stats | {"growth_steps": before})
    return converged_or_raise(fit) if growth.request["throw"] else fit


def _of_all_points(growth: NetGrowth, size: float, base: BSplineSurface, request: dict[str, Any]) -> Fit:
    fit = partial(growth.fit, growth.points, size, base)
    return fit_everywhere(fit, request) if growth.cleaned else fit(request)
