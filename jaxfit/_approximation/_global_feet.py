"""Nearest feet of a whole cloud, before and after a fit, in the problem's unit."""

from typing import Any

import jax
import numpy as np
from jax import Array

from jaxfit._approximation._knot_insertion import Growth
from jaxfit._closest import nearest_feet
from jaxfit._fit._problem import Problem

Feet = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
MAX_STEPS = 60


def global_feet(
    method: Any,
    problem: Problem,
    net: Array,
    growth: Growth | None,
    count: int,
    max_steps: int,
    known: Feet | None = None,
) -> Feet:
    """(u, v, distance, found) of the first `count` points; perhaps nearer than the `known` ones."""
    axes = (problem.axis_u, problem.axis_v) if growth is None else growth.axes
    axis_u, axis_v = (jax.tree.map(np.asarray, axis) for axis in axes)
    used = None if growth is None else (int(axis_u.used), int(axis_v.used))
    points = np.asarray(problem.target)[:, :count].T
    feet = nearest_feet(
        method.foot_method,
        np.asarray(net),
        axis_u,
        axis_v,
        points,
        known=known,
        tolerance=float(problem.foot_tolerance),
        max_steps=MAX_STEPS,
        used=used,
    )
    return feet["u"], feet["v"], np.sqrt(feet["f"]), feet["converged"]
