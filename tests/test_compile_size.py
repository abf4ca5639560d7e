"""Equations traced by the public entries: a budget, which the time to compile them follows."""

import jax
import numpy as np
import pytest
from helpers import clamped_uniform

import jaxfit as jf

RNG = np.random.default_rng(0)
POINTS, GRID = RNG.random((500, 3)), RNG.random((9, 11, 3))
KNOTS = clamped_uniform(9, 4)
START = RNG.random(500), RNG.random(500)


BASE = jf.BSplineSurface(np.random.default_rng(1).random((9, 9, 3)), KNOTS, KNOTS)
FINE = clamped_uniform(26, 4)  # a net too large to be solved by its factors
FINE_BASE = jf.BSplineSurface(np.random.default_rng(1).random((26, 26, 3)), FINE, FINE)


def approximated(method, base=BASE):
    return lambda points: jf.approximate(points, base, method, start=START).surface.control_points


def interpolated(method):
    return lambda grid: jf.interpolate(grid, method).surface.control_points


GEOMETRIC = interpolated(jf.GeometricInterpolation())
ENTRIES = {
    "approximate, geometric": (approximated(jf.GeometricApproximation()), POINTS, 1780),
    "approximate, paper": (approximated(jf.GeometricApproximation.paper()), POINTS, 2380),
    "approximate, standard": (approximated(jf.StandardApproximation(smoothing=1e-5)), POINTS, 2500),
    "approximate, orthogonal": (approximated(jf.OrthogonalDistance()), POINTS, 4450),
    "approximate, orthogonal, fine net": (approximated(jf.OrthogonalDistance(), FINE_BASE), POINTS, 4450),
    "closest_point": (lambda points: jf.closest_point(BASE, points).u, POINTS, 1840),
    "interpolate, geometric": (GEOMETRIC, GRID, 2500),
    "interpolate, geometric, gradient": (jax.grad(lambda grid: GEOMETRIC(grid).sum()), GRID, 5000),
    "interpolate, standard": (interpolated(jf.StandardInterpolation()), GRID, 870),
}


def equations(jaxpr):
    """How many, inner ones counted wherever they are used."""
    inner = [
        x for e in jaxpr.eqns for v in e.params.values() for x in (v if isinstance(v, (tuple, list)) else [v])
    ]
    inner = [getattr(x, "jaxpr", x) for x in inner]
    return len(jaxpr.eqns) + sum(equations(x) for x in inner if hasattr(x, "eqns"))


@pytest.mark.parametrize("name", ENTRIES)
def test_no_entry_traces_more_equations_than_its_budget(name):
    function, argument, budget = ENTRIES[name]
    traced = equations(jax.make_jaxpr(function)(argument).jaxpr)
    assert traced <= budget
