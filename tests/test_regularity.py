"""Regularity: folds are counted and placed, whatever the unit, the dimension and the parameters."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import clamped_uniform, eps, random_surface, wavy_cloud, wavy_grid, wavy_surface

import jaxfit as jf
from jaxfit._normal_equations import thin_plate
from jaxfit._splines._pieces import make_pieces


def spline(net, ends=(0.0, 1.0), dtype=None):
    """Of order (4, 4), over the square of these ends."""
    dtype = jnp.result_type(float) if dtype is None else dtype
    knots = (ends[0] + (ends[1] - ends[0]) * clamped_uniform(n, 4) for n in net.shape[:2])
    return jf.BSplineSurface(*(jnp.asarray(x, dtype) for x in (net, *knots)))


def sheet(bend, n=12):
    """x = bend(u), y = v, z = 0 with `bend` the coefficients of a spline."""
    x, y = np.meshgrid(bend(np.linspace(0, 1, n)), np.linspace(0, 1, n), indexing="ij")
    return np.stack([x, y, 0 * x], axis=2)


def there_and_back(u):
    return np.sin(5.0 * u)


@pytest.mark.float32_too
def test_folds_are_where_normals_of_neighbours_turn_over():
    surface = random_surface()
    found = jf.regularity(surface)
    at = np.linspace(0.0, 1.0, 200)
    normal = np.cross(surface.grid(at, at, 1, 0), surface.grid(at, at, 0, 1))
    along_u, along_v = (
        np.sum(a * b, axis=2) < 0 for a, b in ((normal[1:], normal[:-1]), (normal[:, 1:], normal[:, :-1]))
    )
    assert found.folds == along_u.sum() + along_v.sum() > 100
    assert found.pairs == 79_600
    middle = 0.5 * (at[1:] + at[:-1])
    expected = {(middle[i], at[j]) for i, j in np.argwhere(along_u)}
    expected |= {(at[i], middle[j]) for i, j in np.argwhere(along_v)}
    rounded = {tuple(np.round(x, 9)) for x in expected}
    assert {tuple(np.round(x, 9)) for x in found.fold_parameters} == rounded
    near = np.asarray(surface(*found.fold_parameters.T)) - found.fold_points
    assert np.abs(near).max() < 0.1 * np.ptp(surface.control_points)


@pytest.mark.float32_too
@pytest.mark.parametrize("ends", [(0.0, 1.0), (-3.0, 7.0)])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_two_lines_of_folds_are_two_groups(ends, scale):
    found = jf.regularity(spline(scale * sheet(there_and_back), ends))
    assert (found.folds, found.groups, found.degenerate) == (400, 2, 0)
    assert np.bincount(found.fold_groups).tolist() == [200, 200]
    # Both lines run along v, at the turning points of the spline.
    turning = np.unique(found.fold_parameters[:, 0])
    slope = np.asarray(spline(sheet(there_and_back), ends).derivative(turning, ends[0] + 0 * turning, 1, 0))
    assert np.abs(slope[:, 0]).max() < 0.2
    np.testing.assert_allclose(found.fold_points[:, 2], 0.0, atol=1e-6 * scale)


def test_transposed_and_reversed_surfaces_have_the_same_folds():
    surface = random_surface(seed=4)
    knots = tuple(np.asarray(x) for x in (surface.knots_u, surface.knots_v))
    turned = jf.BSplineSurface(surface.control_points[::-1], 1.0 - knots[0][::-1], knots[1])
    found = [jf.regularity(x) for x in (surface, surface.transpose(), turned)]
    assert len({(x.folds, x.groups) for x in found}) == 1
    for name in ("thin_plate_energy", "curvature_energy", "smallest_angle"):
        np.testing.assert_allclose([getattr(x, name) for x in found], getattr(found[0], name), rtol=1e-9)
    np.testing.assert_allclose(found[1].line_ratios, 1 / np.array(found[0].line_ratios[::-1]), rtol=1e-4)


@pytest.mark.parametrize("dimension", [2, 4])
def test_other_dimensions_have_tangent_planes_too(dimension):
    net = sheet(there_and_back)
    there = np.random.default_rng(0).normal(size=(dimension, 2))
    inclined = net[..., :2] @ np.linalg.qr(there)[0].T
    found, flat = jf.regularity(spline(inclined)), jf.regularity(spline(net))
    assert found.folds == flat.folds == 400
    assert found.fold_points.shape == (400, dimension)
    assert found.curvature_energy is None
    np.testing.assert_allclose(found.smallest_angle, flat.smallest_angle, rtol=1e-9)


def test_a_surface_in_one_dimension_is_degenerate():
    found = jf.regularity(spline(wavy_grid(6, 6)[..., 2:]))
    assert (found.folds, found.degenerate) == (0, 40_000)
    assert found.smallest_angle == 0.0 or np.isfinite(found.smallest_angle)


@pytest.mark.float32_too
@pytest.mark.parametrize("centre", [0.0, 300.0])
def test_a_side_drawn_together_is_no_fold_and_no_nan(centre):
    angle, radius = np.meshgrid(np.linspace(0, 1.5, 8), np.linspace(0, 1, 9), indexing="ij")
    fan = np.stack([radius * np.cos(angle), radius * np.sin(angle), radius**2], axis=2) + centre
    found = jf.regularity(spline(fan))
    assert (found.folds, found.degenerate) == (0, 200)
    assert np.isfinite([found.smallest_angle, *found.line_ratios, found.curvature_energy]).all()
    assert found.smallest_angle > 0.5


def test_a_fold_on_a_sample_without_normal_is_seen():
    """The sheet turns round just where a sample lies, so that no two neighbours have opposite normals."""
    knots = np.array([0.0, 0, 0, 1, 1, 1])
    x, y = np.meshgrid([1.0, -1.0, 1.0], [0.0, 0.5, 1.0], indexing="ij")  # x = (1 - 2 u)^2
    found = jf.regularity(jf.BSplineSurface(np.stack([x, y, 0 * x], axis=2), knots, knots), samples=11)
    assert (found.folds, found.degenerate, found.groups) == (11, 11, 1)
    np.testing.assert_allclose(found.fold_parameters[:, 0], 0.5)


def test_parameter_lines_of_a_sheared_sheet():
    even = np.asarray(jf.greville_abscissae(clamped_uniform(6, 4), 4))
    x, y = np.meshgrid(even, 3.0 * even, indexing="ij")
    found = jf.regularity(spline(np.stack([x + y, y, 0 * x], axis=2)))
    np.testing.assert_allclose(found.smallest_angle, np.pi / 4)
    np.testing.assert_allclose(found.line_ratios, 1.0)


@pytest.mark.float32_too
def test_energies_are_those_of_the_compiled_code():
    for surface in (wavy_surface(9, 7), random_surface((3, 5), seed=3)):
        pieces = make_pieces(jnp.asarray(surface.control_points), surface.knots_u, surface.knots_v)
        plate = thin_plate(pieces.axis_u, pieces.axis_v).energy(jnp.asarray(surface.control_points))
        found = jf.regularity(surface)
        rounding = 1e5 * eps()
        np.testing.assert_allclose(found.thin_plate_energy, float(plate), rtol=rounding)
        if found.folds == 0:
            np.testing.assert_allclose(found.curvature_energy, jf.curvature_energy(surface), rtol=rounding)


def test_knots_to_spare_at_the_end_change_nothing():
    surface = random_surface(seed=1)
    net, knots = np.asarray(surface.control_points), np.asarray(surface.knots_u)
    spare = np.concatenate([net, np.full((3, *net.shape[1:]), 7.0)])
    padded = jf.BSplineSurface(spare, np.append(knots, [1.0, 1.0, 1.0]), surface.knots_v)
    one, other = jf.regularity(surface), jf.regularity(padded)
    assert one.folds == other.folds > 0
    np.testing.assert_allclose(other.thin_plate_energy, one.thin_plate_energy, rtol=1e-12)


def test_large_nets_are_sampled_in_every_span():
    """A wrinkle in one span out of 300, between two of 200 samples."""
    net = sheet(lambda u: u, n=303)[:, :5]
    net[150:152, :, 0] = net[151:149:-1, :, 0]
    found = jf.regularity(spline(net))
    assert found.samples == (1500, 200)
    assert found.folds > 0
    assert jf.regularity(spline(net), samples=20).folds == 0


def test_sharp_crests_of_a_fine_net_are_no_folds():
    """A terrain, so that no normal points downward; its crests turn by 117 degrees within half a span."""
    span = np.arange(103)
    x, y = np.meshgrid(span, [0.0, 50.0, 100.0, 150.0], indexing="ij")
    terrain = spline(np.stack([x, y, 4.0 * (x % 8 == 0)], axis=2))
    assert jf.regularity(terrain).folds == 0
    assert jf.regularity(terrain, samples=200).folds > 0


def test_measuring_compiles_nothing_and_takes_milliseconds():
    surface = wavy_surface(42, 42)
    jf.regularity(surface)  # imports SciPy
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: compiled.append(name))
    before = time.process_time()
    jf.regularity(surface)
    assert time.process_time() - before < 0.5
    assert not [name for name in compiled if "compile" in name or "trace" in name]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: (s, 1), "samples must be a whole number of at least 2"),
        (lambda s: (jax.tree.map(lambda x: np.stack([x, x]), s), None), "a batch"),
        (lambda s: (jax.tree.map(lambda x: x * np.nan, s), None), "must be finite"),
    ],
)
def test_what_cannot_be_measured_gets_a_sentence(change, sentence):
    with pytest.raises((TypeError, ValueError), match=sentence):
        jf.regularity(*change(wavy_surface()))


# ------------------------------------------------------------- on fits


def crossed_grid():
    """A grid with two rows exchanged: every surface through it folds."""
    grid = wavy_grid(12, 9)
    grid[[4, 6]] = grid[[6, 4]]
    return grid


@pytest.mark.float32_too
def test_a_fit_that_folds_does_not_merely_say_converged():
    fit = jf.interpolate(crossed_grid())
    folds = fit.regularity.folds
    assert bool(fit.converged)
    assert folds > 300
    assert fit.message.startswith(
        f"all tolerances are met, but the surface folds at {folds} of 79,600 places: "
    )
    for text in (str(fit), repr(fit)):
        assert fit.message in text
    assert f"at {folds} of 79,600 places in 2 groups, most round u = 0." in str(fit)
    assert fit.regularity is fit.regularity


def test_a_fit_without_folds_says_how_regular_it_is():
    fit = jf.interpolate(wavy_grid(12, 9))
    assert fit.message == "all tolerances are met."
    lines = dict(line.split(maxsplit=1) for line in str(fit).splitlines())
    assert lines["folds"] == "none"
    plate = fit.regularity.thin_plate_energy / float(fit.stats["diagonal"]) ** 2
    assert lines["energies"].startswith(f"thin plate {plate:.4g} squared diagonals, curvature ")
    assert "degrees apart, ratio" in lines["parameter"]
    tiny = jf.interpolate(1e-200 * wavy_grid(12, 9))  # whose diagonal has no square
    assert lines["parameter"] in str(tiny)


def test_a_cloud_that_missed_its_tolerance_tells_of_folds_in_a_sentence_of_their_own():
    points, edges = wavy_cloud(200)
    base = jf.base_surface(jf.Boundary(**edges), points, net=(8, 8))
    net = np.array(base.control_points)
    net[3] += [0.6, 0.0, 0.0]
    folded = jf.BSplineSurface(net, base.knots_u, base.knots_v)
    fit = jf.approximate(points, folded, jf.GeometricApproximation(), tol_average=1e-9, max_steps=0)
    assert not bool(fit.converged)
    assert "average 1e-07 %, maximum without limit" in str(fit)
    assert f" The surface folds at {fit.regularity.folds} of 79,600 places: smooth it more," in fit.message


def test_batches_and_traced_fits_measure_nothing_and_say_so():
    grids = np.stack([wavy_grid(12, 9), crossed_grid()])

    def fitted(grid):
        fit = jf.interpolate(grid)
        with pytest.raises(TypeError, match="surface must have values"):
            _ = fit.regularity
        return fit

    batch = jax.jit(jax.vmap(fitted))(grids)
    with pytest.raises(ValueError, match="is a batch of them"):
        _ = batch.regularity
    smooth, folded = (jax.tree.map(lambda x, i=i: x[i], batch) for i in (0, 1))
    assert smooth.regularity.folds == 0 < folded.regularity.folds
    assert "folds at" in folded.message


def test_what_a_fit_keeps_does_not_outlive_its_surface():
    fit = jf.interpolate(crossed_grid())
    assert fit.regularity.folds > 0
    doubled = jax.tree.map(lambda x: 2 * x if np.shape(x) == (12, 9, 3) else x, fit)
    np.testing.assert_allclose(
        doubled.regularity.thin_plate_energy, 4 * fit.regularity.thin_plate_energy, rtol=1e-12
    )
