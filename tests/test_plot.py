"""Pictures show the whole surface and every error, and leave Matplotlib's global state alone."""

import inspect
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import wavy_surface
from scipy.ndimage import binary_fill_holes, label
from test_trimmed_surface import LOOPS

import jaxfit as jf
from jaxfit.io._output import PICTURES
from jaxfit.plot import history, loops, surface_and_errors, zebra_stripes
from jaxfit.plot._picture import blank_figure
from jaxfit.plot._render import render
from jaxfit.plot._view import choose_view

pytest.importorskip("matplotlib")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr("jaxfit.plot._render._PIXELS", 400)


def test_a_path_in_the_place_of_points_is_told():
    picture = inspect.unwrap(surface_and_errors)  # as users have it, without checks of annotations
    with pytest.raises(TypeError, match=r"points must be an array.*path='errors\.png'"):
        picture(fake_fit((40,)), "errors.png")


def fake_fit(shape, surface=None, seed=0):
    u, v, errors = np.random.default_rng(seed).uniform(size=(3, *shape))
    surface = wavy_surface() if surface is None else surface
    return SimpleNamespace(
        surface=surface,
        regularity=jf.regularity(surface),
        stats={"diagonal": 2.0},
        u=u,
        v=v,
        errors=1e-3 * errors,
        average_error=1e-3 * errors.mean(),
        maximum_error=1e-3 * errors.max(),
    )


def with_points(change):
    surface = wavy_surface()
    net = change(np.asarray(surface.control_points))
    return type(surface)(net, surface.knots_u, surface.knots_v)


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf", ".jpg"])
def test_a_picture_is_saved_and_returned(tmp_path, suffix):
    figure = surface_and_errors(fake_fit((50,)), path=tmp_path / f"p{suffix}", title="cloud")
    assert (tmp_path / f"p{suffix}").stat().st_size > 10_000
    assert [path.name for path in tmp_path.iterdir()] == [f"p{suffix}"]
    said = [text.get_text() for axes in figure.axes for text in (axes.title, axes.yaxis.label)]
    assert any(text.startswith("7 \N{MULTIPLICATION SIGN} 6 control points, no folds\n") for text in said)
    assert "error, % of the diagonal" in said
    assert any(text.startswith("average 0.0") and "maximum 0." in text for text in said)


def test_pictures_are_what_matplotlib_writes():
    assert {suffix[1:] for suffix in PICTURES} <= set(blank_figure(4).canvas.get_supported_filetypes())


def test_a_picture_of_an_unknown_format_is_refused(tmp_path):
    for picture, drawn in ((surface_and_errors, fake_fit((50,))), (zebra_stripes, wavy_surface())):
        for name, said in (("p.foo", "the suffix .foo"), ("p", "no suffix")):
            with pytest.raises(ValueError, match=rf"{name} has {said}, .* use one of \.png, \.pdf, "):
                picture(drawn, path=tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("picture", [surface_and_errors, history, loops])
def test_a_surface_where_a_fit_is_drawn_is_told(picture):
    with pytest.raises(TypeError, match="fit must be what a fit returned, but is a BSplineSurface; draw"):
        picture(wavy_surface())


def test_no_global_state_is_touched():
    surface_and_errors(fake_fit((50,)))
    assert "matplotlib.pyplot" not in sys.modules


def test_errors_of_a_grid_are_an_image():
    points = np.zeros((9, 8, 3))
    flat = surface_and_errors(fake_fit((72,)), points)
    grid = surface_and_errors(fake_fit((9, 8)))
    for figure in (flat, grid):
        assert figure.axes[1].images[0].get_array().shape == (8, 9)
    with pytest.raises(ValueError, match="grid of 9 x 8, but the fit has 50 errors"):
        surface_and_errors(fake_fit((50,)), points)


def test_large_clouds_become_a_raster_of_largest_errors():
    fit = fake_fit((140_000,))
    fit.errors[7] = 1.0
    before = time.perf_counter()
    figure = surface_and_errors(fit)
    assert time.perf_counter() - before < 10
    raster = figure.axes[1].collections[0].get_array()
    assert raster.max() == pytest.approx(100)
    assert raster.size < fit.errors.size / 3


def test_the_surface_fills_its_outline():
    image, _ = render(wavy_surface())
    assert image.shape[1] / image.shape[0] == pytest.approx(1.1, abs=0.01)
    opaque = image[..., 3] > 0.99
    assert 0.2 < opaque.mean() < 0.95
    np.testing.assert_array_equal(binary_fill_holes(opaque), opaque)


@pytest.mark.parametrize("flip", [False, True])
def test_terrain_is_stretched_and_seen_from_above(flip):
    surface = with_points(lambda p: p * np.array([1.0, 1.0, 0.2]))
    net = np.asarray(surface.grid(np.linspace(0, 1, 20), np.linspace(0, 1, 20)))
    view = choose_view(net[::-1] if flip else net)
    assert view.relief == "z"
    assert view.factor > 1
    assert view.toward[2] > 0.5
    assert view.right[0] > 0.7
    assert view.up[1] > 0.5


def test_round_surfaces_are_seen_from_outside():
    angle, height = np.meshgrid(np.linspace(0, np.pi, 20), np.linspace(0, 2, 20), indexing="ij")
    net = np.stack([np.cos(angle), -np.sin(angle), height], axis=-1)
    for view in (choose_view(net), choose_view(net[::-1]), choose_view(net.swapaxes(0, 1))):
        assert view.relief == ""
        assert view.toward[1] < -0.8
        assert view.up[2] > 0.8


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p * np.array([1.0, 1.0, 0.0]),  # a plane
        lambda p: p * np.array([1.0, 0.0, 0.0]),  # collapsed to a line
        lambda p: p * 1e-9,
        lambda p: p + 5e6,
        lambda p: p[..., :2],
        lambda p: p[..., 2:],
    ],
)
def test_odd_surfaces_are_drawn_all_the_same(change):
    image, _ = render(with_points(change))
    assert np.isfinite(image).all()


def test_exact_fits_are_drawn():
    fit = fake_fit((50,))
    fit.errors = np.zeros(50)
    surface_and_errors(fit)


def test_missing_matplotlib_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"jaxfit-surfaces\[plot\]"):
        surface_and_errors(fake_fit((50,)))


def test_folds_are_marked_in_both_halves():
    """A strip pulled back over itself, seen from above: red there and nowhere else."""
    smooth = fake_fit((50,))
    folded = fake_fit((50,), with_points(lambda p: p + 0.9 * np.eye(7)[3][:, None, None] * np.eye(3)[0]))
    red = []
    for fit in (smooth, folded):
        image, _ = render(fit.surface, folds=fit.regularity.fold_parameters)
        red.append(int(np.sum((image[..., 0] > 0.8) & (image[..., 1] < 0.2) & (image[..., 3] > 0))))
    assert folded.regularity.folds > 100
    assert red[0] == 0 < red[1]
    figure = surface_and_errors(folded)
    crosses = [x for x in figure.axes[1].collections if x.get_label() == "folds"]
    np.testing.assert_allclose(crosses[0].get_offsets(), folded.regularity.fold_parameters)
    assert f"{folded.regularity.folds:,} folds" in figure.axes[0].get_title()


def test_folds_of_a_grid_are_marked_at_its_rows_and_columns():
    fit = fake_fit((9, 8), with_points(lambda p: p + 0.9 * np.eye(7)[3][:, None, None] * np.eye(3)[0]))
    fit.u, fit.v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 8), indexing="ij")
    crosses = surface_and_errors(fit).axes[1].collections[0].get_offsets()
    np.testing.assert_allclose(crosses, fit.regularity.fold_parameters * [8, 7], atol=1e-12)


def test_zebra_stripes_stand_below_the_shaded_surfaces():
    figure = zebra_stripes([wavy_surface()] * 2, captions=["a", "b"], shaded=True)
    sizes = [axes.images[0].get_array().shape for axes in figure.axes]
    assert len(sizes) == 4
    assert len(set(sizes)) == 1
    assert [axes.get_title() for axes in figure.axes] == ["a", "b", "", ""]
    seen = (np.asarray(figure.axes[i].images[0].get_array()) for i in (0, 2))
    shaded, striped = (image[image[..., 3] > 0.99][:, :3] for image in seen)
    assert np.std(striped) > 2 * np.std(shaded)


# ---------------------------------------------------------------------- trims


def trimmed_fit(count=500, surface=None):
    fit = fake_fit((count,), surface)
    fit.trimmed = jf.TrimmedSurface(fit.surface, LOOPS["an L with two holes"])
    fit.inside = fit.trimmed.contains(fit.u, fit.v)
    return fit


def test_only_the_inside_of_the_loops_is_drawn():
    for striped in (False, True):
        trimmed = trimmed_fit().trimmed
        figure = zebra_stripes(trimmed, shaded=True)
        opaque = np.asarray(figure.axes[int(striped)].images[0].get_array())[..., 3] > 0.5
        pieces, _ = label(~opaque)
        sizes = np.bincount(pieces.reshape(-1))[1:]
        assert (sizes > 200).sum() == 1 + trimmed.holes  # what is around, and each hole
        assert label(opaque)[1] == 1


def test_errors_and_folds_are_those_inside_the_loops():
    fit = trimmed_fit()
    figure = surface_and_errors(fit)
    inside = np.asarray(fit.inside)
    axes = figure.axes[1]
    assert len(axes.collections[0].get_offsets()) == inside.sum() < 500
    np.testing.assert_array_equal(axes.lines[1].get_xydata()[:-1], fit.trimmed.loops[1])
    within = 100 * fit.errors[inside]
    title = axes.get_title()
    assert f"inside the loops: average {within.mean():.3g} %, maximum {within.max():.3g} %" in title
    assert f"all 500 points: average {100 * fit.average_error:.3g} %" in title
    folded = trimmed_fit(surface=with_points(lambda p: p + 0.9 * np.eye(7)[3][:, None, None] * np.eye(3)[0]))
    places = folded.regularity.fold_parameters
    count = int(np.asarray(folded.trimmed.contains(*places.T)).sum())
    assert 0 < count < len(places)
    assert f"{count:,} folds" in surface_and_errors(folded).axes[0].get_title()


def test_loops_and_history_are_drawn(tmp_path):
    fit = trimmed_fit()
    axes = loops(fit, tmp_path / "l.png").axes[0]
    said = [text.get_text() for text in axes.get_legend().get_texts()]
    inside = int(np.asarray(fit.inside).sum())
    assert said == [f"{inside} points inside", f"{500 - inside} points outside or left out"]
    errors = np.array([1e-2, 1e-3, 1e-4])
    fit.history = SimpleNamespace(average=errors, maximum=3 * errors)
    fit.stats["num_steps"] = 2
    axes = history(fit, tmp_path / "h.png").axes[0]
    np.testing.assert_allclose(axes.lines[0].get_ydata(), 300 * errors)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["h.png", "l.png"]


def test_few_points_outside_the_loops_are_drawn_all_and_large_enough_to_see():
    fit = trimmed_fit(30_000)
    fit.inside = np.ones(30_000, bool)
    fit.inside[[7, 20_001]] = False
    within, outside = loops(fit).axes[0].collections
    assert len(outside.get_offsets()) == 2
    assert np.sqrt(outside.get_sizes()[0]) > 3 > np.sqrt(within.get_sizes()[0])  # points across


def test_a_surface_with_fewer_samples_than_pixels_has_no_gaps(monkeypatch):
    monkeypatch.setattr("jaxfit.plot._render._MOST", 150)
    drawn = render(wavy_surface())[0][..., 3] > 0
    np.testing.assert_array_equal(binary_fill_holes(drawn), drawn)
