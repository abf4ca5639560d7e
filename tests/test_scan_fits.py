"""`fit_points` without a boundary: the surface, its loops, and what the fit says about the points."""

import sys

import jax
import numpy as np
import pytest
from helpers import data, diagonal

import jaxfit as jf
from jaxfit._approximation._checked_scan import checked_scan
from jaxfit._scan import is_nodata

shapely = pytest.importorskip("shapely")


def scan(count=900, seed=0):
    """Points of a wavy sheet over a disc with a hole off its middle."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, 4 * count))
    k = np.arange(2 * count) + 0.5
    radius, angle = np.sqrt(k / len(k)), np.pi * (1 + 5**0.5) * k
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    kept = np.hypot(x - 0.3, y) > 0.25
    return np.stack([x, y, 0.2 * np.sin(2 * x) * np.cos(3 * y)], axis=1)[kept]


def region(fit):
    """The loops as a polygon."""
    outer, *holes = fit.trimmed.loops
    return shapely.Polygon(outer, holes)


def share_inside(fit):
    """Of the finite points, those whose foot is inside the loops."""
    u, v = np.asarray(fit.u), np.asarray(fit.v)
    return shapely.contains_xy(region(fit), u, v)[np.isfinite(u)].mean()


@pytest.fixture(scope="module")
def fit():
    return jf.fit_points(scan(), net=(12, 12), tol_average=1e-4)


def test_a_scan_without_boundary_is_fitted_and_trimmed(fit):
    assert fit.average_error < 1e-4
    assert fit.regularity.folds == 0
    assert region(fit).is_valid
    assert len(fit.trimmed.loops) == 2
    assert share_inside(fit) > 0.98
    area = float(fit.trimmed.area())
    assert np.isclose(area, fit.stats["sheet_area"], rtol=0.02)
    assert fit.stats["feet_on_border"] == 0


def test_loops_have_the_surface_to_their_left(fit):
    outer, hole = (shapely.LinearRing(x) for x in fit.trimmed.loops)
    assert outer.is_ccw
    assert not hole.is_ccw
    assert shapely.Polygon(outer).contains(hole)


def test_hole_and_rim_are_where_they_were(fit):
    outer, hole = (np.asarray(fit.surface(*x.T)) for x in fit.trimmed.loops)
    assert np.allclose(np.hypot(outer[:, 0], outer[:, 1]), 1.0, atol=0.06)
    assert np.allclose(np.hypot(hole[:, 0] - 0.3, hole[:, 1]), 0.25, atol=0.06)


def test_points_that_are_left_out_are_counted_and_keep_their_places(fit):
    points = scan()
    dirty = np.concatenate(
        [points[:7], np.full((2, 3), np.nan), points, points[100:103] + np.array([0, 0, 0.5])]
    )
    again = jf.fit_points(dirty, net=(12, 12), tol_average=1e-4)
    assert again.stats["points_read"] == len(points) + 12
    assert (again.stats["duplicates"], again.stats["non_finite"], again.stats["outliers"]) == (7, 2, 3)
    assert again.errors.shape == (len(points) + 12,)
    inside = np.asarray(again.inside)
    assert (inside[:7] == inside[9:16]).all()
    assert inside[9:16].any()
    assert not inside[7:9].any()
    assert not inside[-3:].any()
    assert np.isnan(again.errors[7:9]).all()
    assert np.isfinite(np.delete(np.asarray(again.errors), [7, 8])).all()
    assert again.maximum_error < 1e-2 < again.errors[-1]
    at = np.asarray(fit.surface(fit.u, fit.v))
    away = jf.closest_point(again.surface, at).distance
    assert np.mean(away) < 2e-4 * diagonal(points)


@pytest.mark.parametrize("value", [-9999.0, -32768.0, 3.4028235e38])
def test_numbers_that_stand_for_no_data_are_left_out_and_counted(fit, value):
    points = scan(1000)
    marked = points.copy()
    marked[:, 2] = np.where(np.hypot(points[:, 0] + 0.5, points[:, 1]) < 0.3, value, points[:, 2])
    count = int((marked[:, 2] == value).sum())
    again = jf.fit_points(np.concatenate([marked, [[np.nan, 0, 0]]]), net=(12, 12), tol_average=1e-4)
    assert count > 50
    assert (again.stats["nodata"], again.stats["non_finite"], again.stats["outliers"]) == (count, 1, 0)
    assert len(again.trimmed.loops) == 3
    assert again.average_error < 1e-4
    assert f"{count} without data" in str(again)


def test_a_height_that_looks_like_no_data_among_others_is_data():
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 90, 20), np.linspace(0, 90, 20), indexing="ij"))
    options = dict(net=(6, 6), method=jf.GeometricApproximation(), max_steps=2)
    assert jf.fit_points(np.stack([x, y, 990 + x / 5], axis=1), **options).stats["nodata"] == 0
    for value, others in ((999.0, 980.0), (9999.0, 9990.0), (-9999.0, -9990.0)):
        heights = np.where(x > 40, value, others + x / 5)
        assert not is_nodata(np.stack([x, y, heights], axis=1)).any()


def test_a_printed_scan_names_the_tolerances_that_were_asked_for(fit):
    assert "average 0.01 %, maximum without limit" in str(fit)


@pytest.mark.slow
def test_the_ends_of_a_scroll_are_fitted_as_well():
    angle, across = np.random.default_rng(0).uniform([[1.5 * np.pi], [0]], [[3 * np.pi], [10]], (2, 3000))
    fit = jf.fit_points(np.stack([angle * np.cos(angle), across, angle * np.sin(angle)], axis=1), net=(24, 8))
    assert fit.converged
    assert fit.maximum_error < 0.007


@pytest.mark.slow
def test_noise_makes_no_sheet_larger(fit):
    points = scan()
    points[:, 2] += np.random.default_rng(1).normal(0, 0.008, len(points))
    noisy = jf.fit_points(points, net=(7, 7), max_steps=3)
    area = float(noisy.trimmed.area())
    assert np.isclose(area, noisy.stats["sheet_area"], rtol=0.02)
    assert np.isclose(area, float(fit.trimmed.area()), rtol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("spacings", [0.35, 1.0])
def test_noise_as_large_as_the_spacing_tears_no_sheet(spacings):
    half, count = np.pi, 1600
    angle, height = (np.arange(count)[:, None] / [1.3247179572, 1.3247179572**2] % 1).T * [[half], [2.0]]
    points = np.stack([np.cos(angle), np.sin(angle), height], axis=1)
    noise = spacings * np.sqrt(2.0 * half / count)
    points += np.random.default_rng(0).normal(0, noise, points.shape)
    fit = jf.fit_points(points, net=(8, 8), max_steps=10)
    at = np.asarray(fit.surface(fit.u, fit.v))[np.asarray(fit.inside)]
    assert fit.folds == 0
    assert len(at) > 0.98 * count
    assert np.abs(np.hypot(at[:, 0], at[:, 1]) - 1.0).mean() < 0.2 * noise
    # Noise along the sheet moves its rim outwards.
    assert 2.0 * half < float(fit.trimmed.area()) < (2.0 + 2 * noise) * (half + 2 * noise) * 1.05


def test_results_are_in_the_frame_of_the_points(fit):
    offset = np.array([5e5, 5.4e6, 100.0])
    moved = jf.fit_points(100 * scan() + offset, net=(12, 12), tol_average=1e-4)
    place = np.asarray(moved.surface(moved.u, moved.v))
    assert np.abs(place - (100 * scan() + offset)).max() < 1.0
    assert np.isclose(moved.stats["hole_length"], 100 * fit.stats["hole_length"], rtol=1e-6)


def test_a_longer_hole_length_closes_the_hole():
    fit = jf.fit_points(scan(), net=(12, 12), hole_length=0.6, max_steps=1)
    assert fit.stats["holes"] == 0
    assert fit.stats["hole_length"] == pytest.approx(0.6)


@pytest.mark.slow
def test_a_drawn_cup_with_vertical_walls_needs_no_parameters():
    points = data("deepdrawing_cup")["points"]
    fit = jf.fit_points(points, net=(33, 33))
    assert fit.average_error <= 6.4e-4
    assert fit.maximum_error <= 1.93e-3
    assert len(fit.trimmed.loops) == 1
    assert share_inside(fit) >= 0.98
    area = float(fit.trimmed.area())
    assert np.isclose(area, fit.stats["sheet_area"], rtol=0.02)


@pytest.mark.parametrize(
    ("change", "error", "sentence"),
    [
        ({"base": jf.Coons()}, ValueError, "base must be None where no boundary"),
        ({"start": (np.zeros(9), np.zeros(9))}, ValueError, "start must be None where no boundary"),
        ({"hole_length": -1.0}, ValueError, "hole_length must be a number of at least 0"),
        ({"faces": np.array([[0, 1]])}, ValueError, "faces must hold three whole numbers"),
        ({"faces": np.array([[0, 1, 10**6]])}, ValueError, "faces must hold numbers of points from 0"),
        ({"net": (3, 3)}, ValueError, "net must be at least 4 x 4"),
        ({"points": np.zeros((40, 2))}, ValueError, "points must have 3 coordinates"),
        ({"points": np.full((40, 3), np.nan)}, ValueError, "points must hold at least 12 distinct"),
        ({"weights": np.ones(3)}, ValueError, "weights must hold one number"),
    ],
)
def test_wrong_arguments_get_a_sentence(change, error, sentence):
    with pytest.raises(error, match=sentence):
        jf.fit_points(**({"points": scan()} | change))


class Table:
    """Points as other libraries hold them: no array, but one on request."""

    def __init__(self, points):
        self.points = points

    def __array__(self, dtype=None, copy=None):
        return np.array(self.points, dtype)


@pytest.mark.parametrize("kind", [Table, list, np.asarray])
def test_gaps_are_seen_in_all_that_is_like_an_array(kind):
    points = scan(20)
    np.testing.assert_array_equal(checked_scan(kind(points), *4 * [None]).points, points)
    points[3, 1] = np.nan
    found = checked_scan(kind(points), *4 * [None]).points
    np.testing.assert_array_equal(np.argwhere(np.isnan(found)), [[3, 1]])


def test_faces_with_a_boundary_are_refused():
    line = np.stack([np.linspace(0, 1, 4), np.zeros(4), np.zeros(4)], axis=1)
    side = line[:, [1, 0, 2]]
    boundary = jf.Boundary(line, line + np.array([0, 1, 0]), side, side + np.array([1, 0, 0]))
    with pytest.raises(ValueError, match="hole_length must be None where there is a boundary"):
        jf.fit_points(line, boundary, hole_length=1.0)


def test_traced_points_get_a_sentence():
    with pytest.raises(TypeError, match="call fit_points outside jit"):
        jax.jit(jf.fit_points)(scan())


def test_a_missing_library_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "shapely", None)
    with pytest.raises(ImportError, match=r'pip install "jaxfit-surfaces\[scan\]"'):
        jf.fit_points(scan())


def test_what_a_file_holds_is_fitted_as_it_is(tmp_path):
    pytest.importorskip("trimesh")
    path = tmp_path / "bent.off"
    points = np.array([[x, y, 0.1 * x * y] for x in range(6) for y in range(5)], float)
    corners = np.array([i + 5 * j for j in range(5) for i in range(4)])
    faces = np.concatenate([corners[:, None] + [0, 5, 6], corners[:, None] + [0, 6, 1]])
    rows = [" ".join(map(str, x)) for x in points.tolist()] + [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    path.write_text("\n".join([f"OFF\n{len(points)} {len(faces)} 0", *rows]) + "\n")
    read = jf.io.read_points(path)
    np.testing.assert_array_equal(read.faces, faces)
    options = dict(net=(6, 5), method=jf.GeometricApproximation(), max_steps=2)
    fit = jf.fit_points(read, **options)
    assert fit.stats["points_read"] == 30
    given = jf.fit_points(points, faces=faces, **options)
    np.testing.assert_array_equal(fit.surface.control_points, given.surface.control_points)
