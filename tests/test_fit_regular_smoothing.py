"""Smoothing that keeps a surface whole: no folds, exact where the points allow it, and no fit to noise."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import clamped_uniform, data, diagonal, grid_edges, wavy_cloud, wavy_net

import jaxfit as jf
from jaxfit._approximation._folds import folds_by_cell, near_folds
from jaxfit._approximation._regular_smoothing import FoldGuard
from jaxfit._normal_equations import Roughness
from jaxfit._splines._pieces import make_pieces

FIRST = jnp.array(jf.RegularSmoothing().first)


def sheet(x, y):
    return np.stack([x, y, 0.1 * np.sin(3 * x + 0.5) * np.cos(2.5 * y)], axis=-1)


def pocketed():
    """A sheet with a bowl under it that a surface reaches only by folding; which points are the bowl."""
    rng = np.random.default_rng(0)
    flat = sheet(*rng.uniform(size=(2, 1350)))
    radius, angle = 0.12 * np.sqrt(rng.uniform(size=150)), 2 * np.pi * rng.uniform(size=150)
    bowl = sheet(0.5 + radius * np.cos(angle), 0.5 + radius * np.sin(angle))
    bowl[:, 2] -= 0.12 * np.sqrt(1 - (radius / 0.12) ** 2)
    return np.concatenate([flat, bowl]), np.arange(1500) >= 1350


BOUNDARY = jf.Boundary(**grid_edges(sheet(*np.meshgrid(*2 * [np.linspace(0, 1, 33)], indexing="ij"))))


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(BOUNDARY, net=(14, 14))


@pytest.fixture(scope="module")
def coarse():
    return jf.base_surface(BOUNDARY, net=(12, 12))


@pytest.mark.slow
def test_points_beyond_a_held_border_are_told_and_met_with_a_free_one():
    points, edges = wavy_cloud(200)
    middle = points.mean(axis=0)
    base = jf.base_surface(
        jf.Boundary(**{k: middle + 0.8 * (x - middle) for k, x in edges.items()}), net=(7, 6)
    )
    held, free = (
        jf.approximate(points, base, jf.OrthogonalDistance(border=border), tol_average=1e-3, max_steps=30)
        for border in (jf.FixedBorder(), jf.FreeBorder())
    )
    assert "border=FreeBorder()" in held.message
    assert "FreeBorder" not in free.message
    assert free.average_error < 0.1 * held.average_error


@pytest.mark.slow
def test_a_pocket_under_the_sheet_makes_no_fold_and_is_out_of_reach(base):
    points, bowl = pocketed()
    fit = jf.approximate(points, base, tol_average=1e-6, max_steps=60)
    assert not fit.converged
    assert fit.regularity.folds == 0
    assert 20 < int(fit.stats["points_out_of_reach"]) <= np.sum(bowl)
    assert "out of reach" in fit.message
    plate = jf.OrthogonalDistance(smoothing=1e-9)
    assert jf.approximate(points, base, plate, tol_average=1e-6, max_steps=60).regularity.folds > 20


@pytest.mark.slow
def test_noise_is_not_fitted(base):
    clean = sheet(*np.random.default_rng(1).uniform(size=(2, 1500)))
    noisy = clean + 0.01 * np.random.default_rng(2).normal(size=clean.shape)
    away = {}
    for smoothing in (jf.RegularSmoothing(), 1e-9, 1e-6, 1e-5):
        method = jf.OrthogonalDistance(smoothing=smoothing)
        fit = jf.approximate(noisy, base, method, tol_average=1e-6, max_steps=30)
        away[smoothing] = float(jnp.mean(jf.closest_point(fit.surface, clean).distance))
    automatic = away.pop(jf.RegularSmoothing())
    assert automatic < 2.0 * min(away.values())
    assert automatic < 0.6 * away[1e-9]


@pytest.mark.slow
def test_weights_and_units_have_no_influence(coarse):
    points, _ = wavy_cloud(1500)
    fit = jf.approximate(points, coarse, tol_average=1e-6, max_steps=5)
    other = jf.BSplineSurface(64.0 * coarse.control_points, coarse.knots_u, coarse.knots_v)
    scaled = jf.approximate(64.0 * points, other, tol_average=1e-6, max_steps=5, weights=np.full(1500, 4.0))
    assert np.abs(np.asarray(scaled.surface.control_points) / 64 - fit.surface.control_points).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("smooth", [False, True])
def test_a_spline_surface_is_found_again(smooth, seed):
    """From smooth bases, too, whose control points have to slide along the surface for many steps."""
    got = data("bspline_reference")
    net, size = got["control_points"], diagonal(got["points"])
    knots = [got[x] / got[x][-1] for x in ("knots_u", "knots_v")]
    rng = np.random.default_rng(seed)
    off = rng.uniform(-1, 1, net.shape)
    off[[0, -1]] = off[:, [0, -1]] = 0.0
    if smooth:
        wave = np.sin(np.pi * np.linspace(0, 1, 6))
        off = wave[:, None, None] * wave[:, None] * rng.standard_normal(3)
    off *= 0.05 * size / np.linalg.norm(off, axis=2).max()
    fit = jf.approximate(got["points"], jf.BSplineSurface(net + off, *knots), tol_average=2e-13)
    away = jf.closest_point(fit.surface, got["grid40"].reshape(-1, 3)).distance
    assert float(jnp.max(away)) < 1e-10 * size
    assert int(fit.stats["num_steps"]) < 40
    assert fit.folds == 0


@pytest.mark.slow
@pytest.mark.parametrize("method", [jf.Coons(), jf.Meshless()])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_spline_surface_is_found_again_from_its_sides(noise, method):
    """A net with a free border slides a long way along the surface, and each step gains little."""
    got = data("bspline_reference")
    knots = [got[x] / got[x][-1] for x in ("knots_u", "knots_v")]
    points, size = got["points"], diagonal(got["points"])
    true, t = jf.BSplineSurface(got["control_points"], *knots), np.linspace(0, 1, 200)
    sides = [np.array(true(*uv)) for uv in ((t, 0 * t), (t, 0 * t + 1), (0 * t, t), (0 * t + 1, t))]
    rng = np.random.default_rng(0)
    for side in sides:
        side[1:-1] += noise * size * rng.normal(size=(198, 3))
    base = jf.base_surface(jf.Boundary(*sides), points, net=(6, 6), method=method)
    base = jf.BSplineSurface(base.control_points, *knots)
    free = jf.OrthogonalDistance(border=jf.FreeBorder())
    fit = jf.approximate(points, base, free, tol_average=1e-13, max_steps=500)
    away = jf.closest_point(fit.surface, got["grid40"].reshape(-1, 3)).distance
    assert fit.converged
    assert float(jnp.max(away)) < 1e-7 * size
    assert float(jnp.mean(away)) < 1e-9 * size
    assert fit.folds == 0


@pytest.mark.slow
@pytest.mark.parametrize("border", [jf.FixedBorder(), jf.FreeBorder()])
def test_a_tolerance_out_of_reach_folds_no_cylinder(border):
    """Of three quarters of a turn, which no net of splines meets."""

    def cylinder(u, v):
        return np.stack([np.cos(1.5 * np.pi * u), 2 * v, np.sin(1.5 * np.pi * u)], axis=-1)

    t = np.linspace(0, 1, 81)
    sides = [cylinder(*uv) for uv in ((t, 0 * t), (t, 0 * t + 1), (0 * t, t), (0 * t + 1, t))]
    base = jf.base_surface(jf.Boundary(*sides), net=(14, 14))
    points = cylinder(*np.random.default_rng(7).uniform(size=(2, 4000)))
    fit = jf.approximate(points, base, jf.OrthogonalDistance(border=border), tol_average=1e-10, max_steps=150)
    assert not fit.converged
    assert fit.folds == 0
    assert float(fit.average_error) < 5e-5


@pytest.mark.parametrize("order", [(4, 4), (3, 5), (2, 4)])
def test_roughness_is_its_matrix_and_ignores_even_nets(order):
    rng = np.random.default_rng(0)
    net = rng.normal(size=(8, 7, 3))
    knots = [
        np.sort(np.concatenate([np.zeros(k), rng.uniform(size=n - k), np.ones(k)]))
        for n, k in zip((8, 7), order, strict=True)
    ]
    form = Roughness.of(jnp.asarray(net), *knots, jnp.asarray(rng.uniform(1, 2, size=(8, 7))))
    matrix, image = form.system(jnp.asarray(net))
    flat = net.reshape(-1, 3)
    dense = np.asarray(matrix.dense())
    assert np.isclose(
        float(form.energy(jnp.asarray(net))), np.einsum("ic,ij,jc", flat, dense, flat), rtol=1e-12
    )
    assert np.allclose(dense @ flat, np.asarray(image).reshape(-1, 3))
    assert np.linalg.eigvalsh(dense).min() > -1e-9 * np.abs(dense).max()
    u, v = (np.asarray(jf.greville_abscissae(x, k)) for x, k in zip(knots, order, strict=True))
    even = np.stack(np.broadcast_arrays(u[:, None], v[None, :], 2 * u[:, None] - v[None, :]), axis=-1)
    assert float(form.energy(jnp.asarray(even))) < 1e-20 * float(form.energy(jnp.asarray(net)))


def test_folds_are_found_in_the_cell_they_are_in():
    knots, net = clamped_uniform(9, 4), wavy_net(9, 9)
    assert not np.asarray(folds_by_cell(make_pieces(jnp.asarray(net), knots, knots))).any()
    net[4, 4:6, 0] -= 0.4  # two control points pushed past those before
    folds = np.asarray(folds_by_cell(make_pieces(jnp.asarray(net), knots, knots)))
    assert folds[1:4, 1:5].sum() > 0
    assert not folds[5:].any()
    near = np.asarray(near_folds(jnp.asarray(folds), (4, 4)))
    assert near.shape == (9, 9)
    assert near[4, 4]


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"least": 0.0}, "least, first and most must be positive"),
        ({"first": 1.0}, "least, first and most must be positive and not decrease"),
        ({"fall": 1.0}, "fall must lie between 0 and 1"),
        ({"raised": 1.0}, "raised be greater than 1"),
    ],
)
def test_impossible_fields_get_a_sentence(fields, sentence):
    with pytest.raises(ValueError, match=sentence):
        jf.RegularSmoothing(**fields)


@pytest.mark.slow
@pytest.mark.parametrize("border", [jf.FixedBorder(), jf.FreeBorder()])
def test_room_for_new_knots_changes_no_fit_before_they_are_there(border):
    points, edges = wavy_cloud(200)
    base = jf.base_surface(jf.Boundary(**edges), net=(7, 6))
    net = np.array(base.control_points)
    net[-2:, 2] = net[-2:, 3] + [0.0, 0.1, 0.0]  # folds at the end behind which the surplus ones are
    base = jf.BSplineSurface(net, base.knots_u, base.knots_v)
    methods = [jf.OrthogonalDistance(border=border, insertion=x) for x in (None, jf.KnotInsertion(every=4))]
    fits = [jf.approximate(points, base, method, tol_average=1e-9, max_steps=6) for method in methods]
    assert all(more > few for more, few in zip(fits[1].surface.shape, base.shape, strict=True))
    first, second = (np.asarray(fit.history.average)[:5] for fit in fits)
    np.testing.assert_allclose(second, first, rtol=1e-4)


@pytest.mark.parametrize("late", [True, False])
def test_only_what_folds_were_kept_out_of_is_smoothed_once_more_and_only_in_time(late):
    smoothing, order = jf.RegularSmoothing(), (4, 4)
    least, nothing = jnp.full((7, 6), smoothing.least), jnp.zeros((7, 6))
    for floor in (least, least.at[3, 3].set(8.0)):
        guard = FoldGuard(floor, floor, nothing, nothing, jnp.zeros((4, 3)), FIRST)
        yes, most = jnp.array(True), 40 if late else 39
        after = smoothing.after(guard, guard, yes, yes, order, jnp.array(25), jnp.array(most))
        if late and floor is not least:
            np.testing.assert_array_equal(after.factor, 0.5 * smoothing.first)
            np.testing.assert_array_equal(after.floor, smoothing.least)
        else:
            np.testing.assert_array_less(after.factor, 8.0)


def test_factors_fall_by_fall_squared_and_rise_to_first_with_the_first_fold():
    smoothing, order, yes, no = jf.RegularSmoothing(), (4, 4), jnp.array(True), jnp.array(False)
    factor, nothing, whole = jnp.full((7, 6), 10.0), jnp.zeros((7, 6)), jnp.zeros((4, 3))
    folded = whole.at[0, 0].set(1.0)
    begun = FoldGuard(factor, jnp.full((7, 6), smoothing.least), nothing, nothing, whole, FIRST)

    def after(guard, folds, good, step=3, better=yes):
        new = dataclasses.replace(guard, folds=folds)
        return smoothing.after(guard, new, better, good, order, jnp.array(step), jnp.array(40))

    np.testing.assert_allclose(after(begun, whole, yes).factor, 10.0 * smoothing.fall**2)
    first = after(begun, folded, no)
    far = np.asarray(first.held) == 0
    assert 0 < far.sum() < far.size
    np.testing.assert_allclose(np.asarray(first.factor)[far], smoothing.first)
    np.testing.assert_allclose(np.asarray(first.factor)[~far], smoothing.raised * smoothing.first)
    second = after(first, folded, no)
    np.testing.assert_allclose(np.asarray(second.factor)[far], smoothing.first)
    np.testing.assert_allclose(np.asarray(after(first, whole, yes).factor)[far], 100.0 * smoothing.fall)
    assert np.asarray(after(first, whole, no).held).max() == 1  # with a better step, which did not fold more
    assert np.asarray(after(first, whole, no, better=no).held).max() == 0
    late = np.asarray(after(begun, folded, no, 26).factor)
    np.testing.assert_allclose(late[far], 10.0)
    begun_folded = dataclasses.replace(begun, folds=folded)
    far = np.asarray(near_folds(folded, order)) == 0
    np.testing.assert_allclose(
        np.asarray(after(begun_folded, folded, yes).factor)[far], 10.0 * smoothing.fall
    )


def test_early_steps_that_fold_are_taken_again_with_all_factors_four_times_as_great():
    smoothing, order, yes, no = jf.RegularSmoothing(), (4, 4), jnp.array(True), jnp.array(False)
    nothing, whole = jnp.zeros((7, 6)), jnp.zeros((4, 3))
    folded = whole.at[0, 0].set(1.0)
    begun = FoldGuard(nothing + smoothing.first, nothing + smoothing.least, nothing, nothing, whole, FIRST)

    def after(guard, step, good=no, folds=folded):
        new = dataclasses.replace(guard, folds=folds)
        return smoothing.after(guard, new, yes, good, order, jnp.array(step), jnp.array(40))

    once = after(begun, 1)
    np.testing.assert_allclose(once.factor, 4 * smoothing.first)
    np.testing.assert_array_equal(once.held, 0)
    np.testing.assert_array_equal(once.floor, smoothing.least)
    np.testing.assert_allclose(after(once, 2).factor, 16 * smoothing.first)
    assert np.asarray(after(once, 6).held).max() == 1  # late
    fallen = after(begun, 1, yes, whole)
    assert np.asarray(after(fallen, 2).held).max() == 1  # after a step with the first factors


@pytest.mark.slow
def test_many_points_to_a_control_point_do_not_crease_a_smooth_surface():
    def field(x, y):
        return np.stack([x, y, 0.1 * np.sin(9 * x + 0.5) * np.cos(7 * y)], axis=-1)

    points = field(*np.random.default_rng(0).uniform(size=(2, 100_000)))
    grid = field(*np.meshgrid(*2 * [np.linspace(0, 1, 200)], indexing="ij"))
    fit = jf.approximate(
        points, jf.base_surface(jf.Boundary.from_grid(grid), net=(42, 42)), tol_average=1e-8, max_steps=10
    )
    assert fit.average_error < 1e-5
    assert fit.regularity.folds == fit.stats["points_out_of_reach"] == 0


def test_many_points_far_from_the_base_are_reached():
    def field(x, y):
        return np.stack([x, y, 0.2 * np.sin(9 * x) * np.cos(7 * y)], axis=-1)

    points = field(*np.random.default_rng(0).uniform(size=(2, 12_000)))
    grid = field(*np.meshgrid(*2 * [np.linspace(0, 1, 200)], indexing="ij"))
    base = jf.base_surface(jf.Boundary.from_grid(grid), net=(16, 16))
    fit = jf.approximate(points, base, tol_average=3e-5, max_steps=30)
    assert fit.history.average[0] > 0.04
    assert fit.converged
    assert fit.regularity.folds == 0


def test_only_bases_near_the_points_and_without_folds_begin_with_less():
    nothing, whole = jnp.zeros((7, 6)), jnp.zeros((4, 3))
    smooth, folded = (FoldGuard(*4 * (nothing,), folds, FIRST) for folds in (whole, whole.at[0, 0].set(1.0)))
    cases = ((smooth, 0, 0.04, 0.04), (smooth, 0, 0.049, 0.245**2), (smooth, 0, 0.0, 0.01))
    cases += ((smooth, 0, 0.051, 1.0), (smooth, 1, 0.02, 1.0), (folded, 0, 0.02, 1.0), (folded, 0, 0.06, 1.0))
    for guard, step, error, expected in cases:
        share, far = guard.at_base(jnp.array(step), jnp.array(error), jnp.array(0.2))
        np.testing.assert_allclose(share, expected, rtol=1e-6)
        assert bool(far) == (error > 0.05)
    no_free_control_point, _ = smooth.at_base(jnp.array(0), jnp.array(0.02), jnp.array(0.0))
    np.testing.assert_array_equal(no_free_control_point, 1.0)


@pytest.mark.slow
def test_a_fit_that_ends_early_is_not_smoothed_once_more(coarse):
    points, _ = pocketed()
    averages = [
        np.asarray(jf.approximate(points, coarse, tol_average=1e-6, max_steps=steps).history.average)
        for steps in (30, 40)
    ]
    assert averages[0].size == 31
    first_fold = 7  # after which the longer fit takes its time
    np.testing.assert_allclose(averages[0][:first_fold], averages[1][:first_fold], rtol=1e-6)
    assert averages[0][26] < 1.01 * averages[0][25]
    assert averages[1][26] > 1.01 * averages[1][25]
