"""The reach that spares searches: no point of the surface is nearer than a foot at less than its reach."""

import numpy as np
import pytest
from scipy.interpolate import NdBSpline
from scipy.spatial import KDTree

import jaxfit as jf
from jaxfit._closest import _reach
from jaxfit._closest._reach import Reach, number_of_samples
from jaxfit._splines._pieces import make_axis

FEET = 4000


def net_of(shape, order, kind):
    """Control points and knots of a thin fold, a sheet bent back, or a scroll."""
    knots = [np.asarray(jf.clamped_uniform_knots(n, k)) for n, k in zip(shape, order, strict=True)]
    x, y = np.meshgrid(
        *([t[i + 1 : i + k].mean() for i in range(len(t) - k)] for t, k in zip(knots, order, strict=True)),
        indexing="ij",
    )
    if kind == "thin fold":
        angle = np.clip((x - 0.5) / 0.1, -1, 1) * np.pi / 2
        far = np.where(abs(angle) < np.pi / 2, 0.0, -abs(x - 0.5))
        return np.stack([far + 0.03 * np.cos(angle), 0.03 * np.sin(angle), y], axis=-1), knots
    if kind == "bent":
        after = np.maximum(x - 0.5, 0.0)
        return np.stack([np.minimum(x, 0.5) + after * np.cos(2.9), after * np.sin(2.9), y], axis=-1), knots
    angle = 14.0 * x
    radius = 0.2 + 0.02 * angle
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), y], axis=-1), knots


def feet_and_points(net, knots, order):
    """Parameters inside the domain, and points along the normals there at all distances of interest."""
    rng = np.random.default_rng(0)
    feet = rng.uniform(size=(FEET, 2))
    surface = NdBSpline(tuple(knots), net, tuple(k - 1 for k in order))
    normal = np.cross(surface(feet, nu=(1, 0)), surface(feet, nu=(0, 1)))
    normal *= rng.choice([-1.0, 1.0], (FEET, 1)) / np.linalg.norm(normal, axis=1, keepdims=True)
    distance = 10 ** rng.uniform(-3.5, -0.5, FEET)
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 400)], indexing="ij"), axis=-1).reshape(-1, 2)
    nearest = KDTree(surface(grid)).query(surface(feet) + distance[:, None] * normal)[0]
    return feet, distance, nearest


@pytest.mark.parametrize("kind", ["thin fold", "bent", "scroll"])
@pytest.mark.parametrize("order", [(3, 3), (4, 4), (6, 4)])
@pytest.mark.parametrize("shape", [(7, 8), (12, 7), (40, 9)])
def test_nothing_is_nearer_than_feet_below_the_reach(monkeypatch, shape, order, kind):
    monkeypatch.setattr(_reach, "POINTS_PER_SAMPLE", 0)  # as with so many feet that more neighbours pay
    net, knots = net_of(shape, order, kind)
    feet, distance, nearest = feet_and_points(net, knots, order)
    axes = [make_axis(t.astype(float), k) for t, k in zip(knots, order, strict=True)]
    below = Reach(net, *axes).exceeds(*feet.T, distance)
    assert 0.05 < below.mean() < 0.95
    assert not np.any(below & (nearest < 0.999 * distance))


def test_more_neighbours_raise_the_reach_of_an_even_sheet_where_there_are_many_feet(monkeypatch):
    knots = np.asarray(jf.clamped_uniform_knots(30, 4))
    x, y = np.meshgrid(*2 * [np.linspace(0, 1, 30)], indexing="ij")
    net, axis = np.stack([x, y, 0.02 * np.sin(6 * x)], axis=-1), make_axis(knots, 4)
    u, v = np.random.default_rng(0).uniform(0.2, 0.8, (2, FEET))
    distance = np.full(FEET, 0.06)
    assert not Reach(net, axis, axis).exceeds(u, v, distance).any()
    monkeypatch.setattr(_reach, "POINTS_PER_SAMPLE", 0)
    assert Reach(net, axis, axis).exceeds(u, v, distance).all()


def test_few_cells_have_many_samples_and_many_cells_one_each():
    few, many = (make_axis(np.asarray(jf.clamped_uniform_knots(n, 4)), 4) for n in (5, 43))
    assert number_of_samples(few, few) == 17 * 17
    assert number_of_samples(many, few) == 41 * 17
