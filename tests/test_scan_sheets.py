"""Points without a boundary: what is left out, what is no sheet, and how a sheet is laid out."""

import numpy as np
import pytest
from helpers import data

from jaxfit._scan import _sheet_mesh, sheet_of
from jaxfit._scan._cleaning import cleaned
from jaxfit._scan._manifold import areas, boundary_loops, manifold, pieces, single_fans

pytest.importorskip("shapely")


def square(n=16, seed=0):
    """Points of a wavy sheet over the unit square, jittered."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    x, y = (a.ravel() + np.random.default_rng(seed).uniform(-0.2, 0.2, n * n) / n for a in (x, y))
    return np.stack([x, y, 0.1 * np.sin(3 * x) * np.cos(2 * y)], axis=1)


def cylinder(length=3.0, around=24):
    """Points of an open tube of radius 1."""
    angle, height = np.meshgrid(
        np.linspace(0, 2 * np.pi, around, endpoint=False),
        np.linspace(0, length, int(length * around / 6)),
        indexing="ij",
    )
    angle = angle + 0.01 * np.sin(7 * height)
    return np.stack([np.cos(angle), np.sin(angle), height], axis=2).reshape(-1, 3)


def half_cylinder():
    points = cylinder()
    return points[points[:, 1] > -1e-9]


def sphere(count=500):
    """Evenly spread points of the unit sphere."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)


def open_torus():
    """Points of a torus of which a patch is missing: a sheet with a handle."""
    angles = [np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (48, 20)]
    turn, around = np.meshgrid(*angles, indexing="ij")
    radius = 1.0 + 0.4 * np.cos(around)
    torus = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0.4 * np.sin(around)], axis=2)
    torus = torus.reshape(-1, 3)
    return torus[np.linalg.norm(torus - [1.4, 0, 0], axis=1) > 0.6]


def test_a_square_sheet_has_one_loop_and_fills_its_rectangle():
    sheet = sheet_of(square())
    assert len(sheet.loops) == 1
    assert sheet.on_sheet.all()
    layout = sheet.layout((10, 10), (4, 4))
    assert np.allclose(np.ptp(layout.parameters, axis=0), 1 - 1 / 7, atol=0.07)
    assert [len(x) for x in layout.knots] == [14, 14]
    assert layout.parameters.min() > 0
    assert layout.parameters.max() < 1


def wing(seed, count):
    """Points of both skins of a wing, all round its leading edge, open at the trailing one by less than most
    neighbours are apart; on which skin each is, and at which share of the chord.
    """
    u, v = np.random.default_rng(seed).uniform(size=(2, count))
    side, chord = np.sign(2 * u - 1), 1.5 - 0.8 * v
    t = np.abs(2 * u - 1)
    x = t**2
    half = 0.6 * (0.2969 * t - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1015 * x**4)
    return np.stack([chord * x + 0.9 * v, 5 * v, chord * side * (half + 0.02 * x)], axis=1), side, x


@pytest.mark.parametrize(("seed", "count"), [(2, 6000), (5, 6000), (0, 12_000)])
def test_the_skins_of_a_wing_are_joined_round_its_leading_edge_alone(seed, count):
    points, side, chord_share = wing(seed, count)
    sheet = sheet_of(points)
    assert sheet.on_sheet.mean() > 0.99
    assert len(sheet.loops) == 1
    kept, share = sheet.number[sheet.on_sheet], chord_share[sheet.number[sheet.on_sheet]]
    upper, lower = (sheet.places[sheet.on_sheet][(share > 0.8) & (side[kept] == s)] for s in (1, -1))
    apart = np.quantile(np.linalg.norm(upper[:, None] - lower[None], axis=2), 0.05, axis=1)
    assert np.quantile(apart, 0.1) > 0.2 * sheet.sides.max()


def test_what_is_left_out_is_counted():
    points = square(20)
    far = points[::60] + np.array([0, 0, 0.4])
    gaps = np.full((3, 3), np.nan)
    stray = points[:4] * 0.1 + 5.0
    sheet = sheet_of(np.concatenate([points, points[:5], far, gaps, stray]))
    assert sheet.counts["points_read"] == 400 + 5 + 7 + 3 + 4
    assert sheet.counts["duplicates"] == 5
    assert sheet.counts["non_finite"] == 3
    assert sheet.counts["outliers"] + sheet.counts["off_the_sheet"] == 7 + 4
    assert set(sheet.number[sheet.on_sheet]) == set(range(400))


@pytest.mark.parametrize(("count", "size"), [(50, 10.0), (250, 10.0), (250, 3.0)])
def test_points_strewn_about_a_sheet_are_outliers(count, size):
    """They are each other's neighbours, so that none is far from all others."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, size=(2, 5000))
    sheet = np.stack([x, y, 0.3 * np.sin(2 * x) * np.cos(3 * y)], axis=1)
    found = cleaned(np.concatenate([sheet, rng.uniform(-size, size, size=(count, 3))]))
    assert (found.kept < 5000).sum() >= 4998
    assert (found.kept >= 5000).sum() <= 0.1 * count


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_one_stray_in_ten_pulls_no_flaps_out_of_a_sheet(seed):
    """They are not so sparse that each is alone, and would be joined to the rim by long triangles."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1, 1, size=(2, 1500))
    points = np.stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y)], axis=1)
    astray = rng.choice(1500, 150, replace=False)
    points[astray, 2] += rng.uniform(0.3, 2, 150) * rng.choice([-1, 1], 150)
    sheet = sheet_of(points)
    on_sheet = sheet.number[sheet.on_sheet]
    assert not np.isin(astray, on_sheet).any()
    assert len(on_sheet) >= 1345
    assert sheet.hole_length < 0.4


def test_points_at_a_wrong_level_are_no_second_sheet():
    """They are few, if far apart: their triangles are as large as the sheet."""
    x, y = (np.random.default_rng(0).uniform(0, 1, (4800, 2)) * [80, 60]).T
    points = np.stack([x, y, 100 + 5 * np.sin(x / 20)], axis=1)
    points[:100, 2] = 0.0
    sheet = sheet_of(points)
    assert sheet.counts["off_the_sheet"] == 100
    assert not sheet.on_sheet[:100].any()
    assert sheet.area == pytest.approx(4860, rel=0.04)


def test_points_that_do_not_count_have_no_say_in_the_sheet():
    points = square(24)
    above = points[::3] + 0.1 * np.eye(3)[2]
    counted = np.arange(len(points) + len(above)) < len(points)
    sheet = sheet_of(np.concatenate([points, above]), counted=counted)
    alone = sheet_of(points)
    np.testing.assert_array_equal(sheet.faces, alone.faces)
    assert sheet.area == alone.area
    assert len(sheet.nearest) == len(counted)
    assert sheet.counts["non_finite"] == 0


def test_no_point_is_an_outlier_where_a_sheet_turns_sparse():
    """Half a cylinder of 20,000 points, a tenth of it a hundred times as dense."""
    x, y = np.random.default_rng(4).random((2, 20_000))
    x[:18_000] *= 0.1
    points = np.stack([np.cos(np.pi * x), np.sin(np.pi * x), y], axis=1)
    assert cleaned(points).outliers == 0


def test_a_hole_wider_than_the_length_is_a_hole():
    points = square(24)
    points = points[np.hypot(points[:, 0] - 0.5, points[:, 1] - 0.5) > 0.2]
    assert len(sheet_of(points).loops) == 2
    assert len(sheet_of(points, hole_length=0.7).loops) == 1


@pytest.mark.parametrize("points", [100 * square(), sphere()[:350]], ids=["level", "bent"])
def test_a_hole_length_below_the_distance_of_neighbours_is_said(points):
    faces = sheet_of(points).faces
    for given in (None, faces):
        with pytest.raises(
            ValueError, match=r"^hole_length is 0\.05, but neighbours are some .* apart; raise it\.$"
        ):
            sheet_of(points, given, hole_length=0.05)


def test_a_sheet_that_overhangs_is_laid_out_without_flips():
    around, along = np.meshgrid(np.linspace(0, 1.6 * np.pi, 50), np.linspace(0, 1, 12), indexing="ij")
    roll = np.stack([0.5 * np.cos(around), 0.5 * np.sin(around), along], axis=2).reshape(-1, 3)
    sheet = sheet_of(roll)
    assert np.isclose(sheet.sides[0] * sheet.size, 0.8 * np.pi, rtol=0.02)
    assert len(sheet.faces) == 2 * 49 * 11
    assert np.isclose(sheet.sides[1] * sheet.size, 1.0, rtol=0.02)
    node = np.argmin(np.linalg.norm(sheet.points[None] - sheet.nodes[:, None], axis=2), axis=1)
    corners = sheet.places[node][sheet.faces]
    (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    turn = np.sign(a * d - b * c)
    assert (turn == turn[0]).all()


def test_faces_of_a_file_are_used():
    points = square(10)
    sheet = sheet_of(points)
    again = sheet_of(points, faces=sheet.faces)
    assert len(again.faces) == len(sheet.faces)
    assert np.isclose(again.area, sheet.area)


def test_units_offsets_and_order_do_not_matter():
    points = square(14)
    one, other = sheet_of(points), sheet_of(1e3 * points[::-1] + [5e5, 5e6, 0])
    assert np.allclose(one.sides, other.sides, rtol=0.02)
    assert np.isclose(other.area, 1e6 * one.area, rtol=1e-6)


@pytest.mark.parametrize(
    ("points", "sentence"),
    [
        (cylinder(), "runs round like a tube; cut .* lower hole_length if it has a gap"),
        (sphere(), "closed like a sphere"),
        (np.concatenate([square(), square() + np.array([3.0, 0, 0])]), "several pieces"),
        (np.concatenate([half_cylinder(), half_cylinder() + np.array([6.0, 0, 0])]), "several pieces"),
        (open_torus(), "1 handle "),
        (square(3), "at least 12"),
        (square() * [1, 1e-9, 0] + [5e5, 5e6, 0], "lie on a line"),
    ],
    ids=["tube", "sphere", "two pieces", "two shells", "handle", "few", "line"],
)
def test_what_is_no_sheet_is_said(points, sentence):
    with pytest.raises(ValueError, match=sentence):
        sheet_of(points)


@pytest.mark.parametrize(
    "heights",
    [
        lambda x, y: 6 * np.sin(x / 15) * np.cos(y / 12),
        lambda x, y: np.round(6 * np.sin(x / 15) * np.cos(y / 12), 1),
        lambda x, y: 1e-2 * ((x - 30) ** 2 + (y - 20) ** 2),
        lambda x, y: 5 * np.sin(x / 20),
        lambda x, y: 0.02 * (x - 30) ** 2,
    ],
    ids=["waves", "rounded", "bowl", "bent one way", "trough"],
)
def test_a_bent_grid_without_gaps_has_all_its_triangles(heights):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(60.0), np.arange(45.0), indexing="ij"))
    sheet = sheet_of(np.stack([x, y, heights(x, y)], axis=1))
    assert len(sheet.nodes) == len(x)
    # At the rim, where points are not quite on a line, there may be a thin triangle more.
    assert 2 * 59 * 44 <= len(sheet.faces) < 2 * 59 * 44 + 5
    assert len(sheet.loops) == 1


@pytest.mark.parametrize("ratio", [10, 20])
def test_the_rim_of_scan_lines_has_no_notches(ratio):
    """A waved square, `ratio` times as dense along 30 lines as across them."""
    x, y = np.meshgrid(np.linspace(0, 1, 29 * ratio + 1), np.linspace(0, 1, 30), indexing="ij")
    sheet = sheet_of(np.stack([x, y, 0.1 * np.sin(3 * x) * np.cos(2 * y)], axis=2).reshape(-1, 3))
    assert len(sheet.loops) == 1
    rim = (sheet.nodes[sheet.loops[0]] * sheet.size + sheet.centre)[:, :2]
    assert np.minimum(rim, 1 - rim).min(axis=1).max() < 1 / 29


@pytest.mark.parametrize("along", [60, 100, 200, 1000])
def test_few_scan_lines_have_no_wedges_between_them(along):
    """Stars of neighbouring lines disagree on the diagonal where the sheet bends."""
    x, y = np.meshgrid(np.linspace(-1, 1, along), np.linspace(-1, 1, 15), indexing="ij")
    sheet = sheet_of(np.stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y)], axis=2).reshape(-1, 3))
    assert len(sheet.loops) == 1
    rim = (sheet.nodes[sheet.loops[0]] * sheet.size + sheet.centre)[:, :2]
    assert (1 - np.abs(rim)).min(axis=1).max() < 0.1
    assert sheet.area > 0.96 * 4.496


def test_notches_are_filled_and_nothing_else():
    """Around a point a fan of three triangles with a gap of one; the fifth has one edge in common with it."""
    fan = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    ear, other = [0, 4, 1], [2, 1, 5]
    np.testing.assert_array_equal(manifold(fan, np.array([other, ear])), [*fan.tolist(), ear])


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.7])
def test_the_sheet_reaches_both_ends_of_scan_lines(shift):
    """Of 20 lines with 400 points each the ends would be lost where the mesh has one in twenty of these."""
    x, y = np.meshgrid(np.linspace(0, 1, 400) + shift, np.linspace(0, 1, 20) + shift, indexing="ij")
    sheet = sheet_of(np.stack([x, y, 0.1 * np.sin(4 * x) * np.cos(3 * y)], axis=-1).reshape(-1, 3))
    nodes = sheet.nodes * sheet.size + sheet.centre - shift
    assert len(nodes) < 2000
    for line in np.linspace(0, 1, 20):
        along = nodes[np.isclose(nodes[:, 1], line), 0]
        assert along.min() < 0.01
        assert along.max() > 0.99


@pytest.mark.parametrize("lines", [14, 34])
def test_scan_lines_with_few_points_across_make_one_sheet(lines):
    """Half a cylinder, 10 to 60 times as dense along lines as across them."""
    x, y = np.meshgrid(np.linspace(0, 1, 12_000 // lines), np.linspace(0, 1, lines), indexing="ij")
    y = y + 0.05 / lines * np.random.default_rng(0).normal(size=y.shape)
    sheet = sheet_of(np.stack([np.cos(np.pi * x), np.sin(np.pi * x), np.pi * y], axis=2).reshape(-1, 3))
    assert len(sheet.loops) == 1
    assert sheet.on_sheet.all()
    assert np.isclose(sheet.area, np.pi**2, rtol=0.1)
    assert np.allclose(np.ptp(sheet.places, axis=0), sheet.sides, rtol=1e-9)


def test_a_narrow_strip_is_no_scan_line():
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 3000)) * [[1.0], [0.025]]
    sheet = sheet_of(np.stack([x, y, 0.3 * np.sin(2.5 * x) * np.cos(2 * y)], axis=1))
    assert len(sheet.nodes) > 2900
    assert sheet.hole_length < 0.04
    assert sheet.area == pytest.approx(0.11, rel=0.1)


def test_a_band_with_a_twist_of_triangles_is_no_manifold():
    faces = np.array([[0, 1, 2], [0, 1, 3], [2, 1, 4]])
    kept = manifold(faces)
    assert len(kept) == 2
    assert (pieces(kept) == 0).all()
    assert len(boundary_loops(kept)) == 1
    assert areas(np.eye(5)[:, :3], kept).shape == (2,)


def hairpin(seed, spacing=0.7):
    """Points of a sheet round a bend, its far sides nearer to each other than many of its neighbours, and how
    far along the sheet each is.
    """
    rng = np.random.default_rng(seed)
    along, height = np.meshgrid(np.arange(-10, 10, spacing), np.arange(0, 12, spacing), indexing="ij")
    along, height = (x.ravel() + rng.uniform(-0.4, 0.4, x.size) * spacing for x in (along, height))
    half = np.sign(along) * (1 - np.exp(-np.abs(along))) * (1.2 - 0.075 * np.abs(along))
    return np.stack([np.sqrt(along**2 + 1), half, height], axis=1), along


@pytest.mark.parametrize("seed", [0, 7])
def test_sides_that_face_each_other_closely_are_not_joined(seed):
    points, along = hairpin(seed)
    sheet = sheet_of(points)
    node = np.argmin(np.linalg.norm(sheet.points[None] - sheet.nodes[:, None], axis=2), axis=1)
    assert np.ptp(along[sheet.number[node]][sheet.faces], axis=1).max() < 4
    assert len(sheet.loops) == 1


def test_a_thin_blade_has_no_notches_in_its_rim():
    arrays = data("blade_wrap_3000")
    sheet = sheet_of(arrays["points"])
    rim = sheet.nodes[sheet.loops[0]] * sheet.size + sheet.centre
    sides = [arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")]
    dense = np.concatenate([np.linspace(x[:-1], x[1:], 20).reshape(-1, 3) for x in sides])
    away = np.linalg.norm(rim[:, None] - dense[None], axis=2).min(axis=1)
    assert away.max() < 1.5 * sheet.spacing * sheet.size


def roll(turns=2, around=160, along=24):
    """Points of a sheet that is rolled up, its layers a quarter of a unit apart, and its triangles."""
    angle, height = np.meshgrid(
        np.linspace(0, 2 * np.pi * turns, around), np.linspace(0, 3, along), indexing="ij"
    )
    radius = 1 + 0.25 * angle / (2 * np.pi)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    first = (along * np.arange(around - 1)[:, None] + np.arange(along - 1)).ravel()
    after = first + along
    halves = [first, after, after + 1], [first, after + 1, first + 1]
    return points, np.concatenate([np.stack(x, axis=1) for x in halves])


def test_faces_of_a_large_file_tell_sheets_apart_that_are_nearer_than_the_nodes(monkeypatch):
    monkeypatch.setattr(_sheet_mesh, "MOST_NODES", 300)
    points, faces = roll()
    sheet = sheet_of(points, faces=faces)
    assert len(sheet.nodes) <= 300
    assert sheet.on_sheet.all()
    assert len(sheet.loops) == 1
    whole = areas(points, faces).sum()
    assert 0.85 * whole < sheet.area < whole  # the nodes lie inside the rim
    rim = points.reshape(160, 24, 3)[:, 0]
    along = np.cumsum(np.linalg.norm(np.diff(rim, axis=0, prepend=rim[:1]), axis=1)).repeat(24)[sheet.number]
    place = sheet.places[:, 0] * sheet.size
    place = place if np.corrcoef(place, along)[0, 1] > 0 else place.max() - place
    assert np.abs(place - along - np.median(place - along)).max() < 1  # the layers are 6 apart and more


@pytest.mark.parametrize("count", [12, 30, 100, 400])
def test_points_all_over_the_place_are_no_sheet(count):
    with pytest.raises(ValueError, match="points must"):
        sheet_of(np.random.default_rng(0).normal(size=(count, 3)))


def test_triangles_that_touch_at_a_point_only_are_left_out():
    """As those of given faces do where longer ones between them are left out."""
    faces = np.array([[0, 1, 2], [0, 3, 4], [0, 4, 5]])
    kept = single_fans(faces)
    np.testing.assert_array_equal(kept, faces[1:])
    assert [sorted(loop) for loop in boundary_loops(kept)] == [[0, 3, 4, 5]]
