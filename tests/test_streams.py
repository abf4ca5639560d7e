"""Clouds that are read in blocks have the fits of clouds in memory."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from helpers import count_compilations, eps, slow_except, wavy_cloud

import jaxfit as jf

POINTS, EDGES = wavy_cloud(3000)
POINTS = POINTS + 1e-3 * np.random.default_rng(1).normal(size=POINTS.shape)
WEIGHTS = np.random.default_rng(2).integers(0, 3, len(POINTS)).astype(float)
GOALS = dict(tol_average=1e-7, max_steps=4)
BLOCK = 700


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(jf.Boundary(**EDGES), net=(8, 7))


@pytest.fixture(scope="module")
def streamed(base):
    return jf.approximate_stream(POINTS, base, block_size=BLOCK, **GOALS)


def assert_same(one, other):
    """Surface, errors, history and reason; single precision for what every point has its own of."""
    tolerance = 1e4 * eps()
    for name in ("average_error", "maximum_error"):
        assert float(getattr(one, name)) == pytest.approx(float(getattr(other, name)), abs=tolerance)
    net = np.asarray(one.surface.control_points)
    np.testing.assert_allclose(net, other.surface.control_points, rtol=0, atol=tolerance)
    for name in ("average", "maximum"):
        here, there = (np.asarray(getattr(x.history, name)) for x in (one, other))
        np.testing.assert_allclose(here, there, rtol=0, atol=tolerance)
    assert np.array_equal(one.history.active, other.history.active)
    assert one.result == other.result
    for name in ("u", "v", "errors"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=2e-7)


METHODS = {
    "standard": jf.StandardApproximation(),
    "fixed parameters": jf.StandardApproximation(smoothing=0.0, parameter_correction=False),
    "single steps": jf.GeometricApproximation(border=jf.FreeBorder(), loss=jf.Huber(1e-3)),
    "paper": jf.GeometricApproximation.paper(insertion=None),
}


@pytest.mark.parametrize("name", slow_except(METHODS, "standard"))
def test_a_fit_in_blocks_is_the_fit_in_memory(base, name):
    method = METHODS[name]
    if name == "paper":  # in memory feet start ahead: the tolerance of feet is what both share
        method = dataclasses.replace(method, foot_tolerance=1e-14)
    fits = (
        jf.approximate(POINTS, base, method, **GOALS),
        jf.approximate_stream(POINTS, base, method, block_size=BLOCK, **GOALS),
    )
    assert_same(*fits)
    assert fits[0].stats["method"] == fits[1].stats["method"]


def test_weights_starts_and_places_of_errors_are_those_of_approximate(base):
    found = jf.closest_point(base, POINTS)
    options = dict(weights=WEIGHTS, start=(found.u, found.v), errors=jf.AtParameters(), **GOALS)
    options |= dict(method=jf.StandardApproximation())
    assert_same(
        jf.approximate(POINTS, base, **options),
        jf.approximate_stream(POINTS, base, block_size=BLOCK, **options),
    )


def test_every_kind_of_source_gives_the_same_fit(base, streamed, tmp_path):
    path = tmp_path / "points.npy"
    np.save(path, POINTS)
    cuts = [0, 1, 800, 800, 2900, 3000]
    sources = [
        path,
        jax.device_put(POINTS),
        np.load(path, mmap_mode="r"),
        [POINTS[a:b] for a, b in itertools.pairwise(cuts)],
        lambda: (POINTS[k : k + 450] for k in range(0, 3000, 450)),
    ]
    for source in sources:
        fit = jf.approximate_stream(source, base, block_size=BLOCK, **GOALS)
        assert np.array_equal(fit.surface.control_points, streamed.surface.control_points)
        assert np.array_equal(fit.errors, streamed.errors)


def test_another_cloud_in_blocks_of_the_same_size_compiles_nothing(base, streamed):
    with count_compilations() as compiled:
        jf.approximate_stream(POINTS[:2500] + 0.01, base, block_size=BLOCK, **GOALS)
    assert compiled.count == 0


def test_feet_go_to_a_file_that_holds_u_v_and_errors(base, streamed, tmp_path):
    path = tmp_path / "feet.npy"
    fit = jf.approximate_stream(POINTS, base, block_size=BLOCK, feet_file=path, **GOALS)
    assert isinstance(fit.errors, np.memmap)
    stored = np.load(path)
    assert np.array_equal(stored, np.stack([streamed.u, streamed.v, streamed.errors]))
    feet = jf.closest_point(fit.surface, POINTS, start=(stored[0], stored[1]))
    diagonal = fit.stats["diagonal"]
    np.testing.assert_allclose(np.asarray(feet.distance) / diagonal, stored[2], rtol=0, atol=1e-7)


def test_a_fit_that_is_broken_off_leaves_no_file_of_feet(base, tmp_path):
    def broken_off(step, *_):
        assert (tmp_path / "feet.npy").exists()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        jf.approximate_stream(
            POINTS, base, block_size=BLOCK, feet_file=tmp_path / "feet.npy", progress=broken_off, **GOALS
        )
    assert not list(tmp_path.iterdir())


def test_progress_is_reported_after_every_pass(base, streamed):
    seen = []
    jf.approximate_stream(POINTS, base, block_size=BLOCK, progress=lambda *x: seen.append(x), **GOALS)
    assert [x[0] for x in seen] == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal([x[2] for x in seen], streamed.history.average)
    assert streamed.stats["passes"] == len(seen) + 2


def test_a_diverging_fit_goes_back_to_its_last_good_surface(base, monkeypatch):
    monkeypatch.setattr("jaxfit._fit._loop.MAX_AVERAGE", 1e-9)
    places = np.random.default_rng(3).random((2, 3000))
    points = np.asarray(base(*places))  # so near that any smoothing is far worse
    # A stall window of its own, and so a program.
    method = jf.StandardApproximation(smoothing=1e6, border=jf.FreeBorder(), stall_window=17)
    options = dict(block_size=BLOCK, errors=jf.LocalFeet())
    fit = jf.approximate_stream(points, base, method, 0.0, **options)
    assert fit.result == jf.RESULTS.diverged
    assert np.array_equal(fit.surface.control_points, base.control_points)
    assert fit.errors.max() < 1e-9
    np.testing.assert_allclose(fit.u, places[0], rtol=0, atol=1e-6)


# ------------------------------------------------------------------ refused


def bad_block():
    blocks = [POINTS[:1000].copy(), POINTS[1000:2000].copy(), POINTS[2000:].copy()]
    blocks[1][17, 2] = np.nan
    return blocks


def test_files_that_cannot_be_used_are_refused(base, tmp_path):
    path, archive = tmp_path / "points.npy", tmp_path / "points.npz"
    np.save(path, POINTS)
    np.savez(archive, points=POINTS)
    with pytest.raises(FileNotFoundError, match=r"missing\.npy does not exist; check its name and folder\."):
        jf.approximate_stream(tmp_path / "missing.npy", base)
    with pytest.raises(ValueError, match=r"feet_file must be a file of its own, but .*points\.npy is read"):
        jf.approximate_stream(path, base, feet_file=path)
    assert np.array_equal(np.load(path), POINTS)
    with pytest.raises(
        ValueError, match=r"source must be the path of a \.npy file, but .*points\.npz is none"
    ):
        jf.approximate_stream(archive, base)
    with pytest.raises(OSError, match=r"feet_file .*feet\.npy cannot be written: No such file"):
        jf.approximate_stream(path, base, feet_file=tmp_path / "none" / "feet.npy")
    with pytest.raises(OSError, match=r"source .* cannot be read: Is a directory"):
        jf.approximate_stream(tmp_path, base)
    whole = path.read_bytes()
    for cut in (100, len(whole) - 40):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"source cannot be mapped, for .*points\.npy was cut short"):
            jf.approximate_stream(path, base)


REFUSED = {
    "NaN": (bad_block(), r"block 1 of source, from point 1000 on, must be finite, .* index \(17, 2\); rem"),
    "shape": ([POINTS, POINTS[:, :2]], "block 1 of source, from point 3000 on, must have 3 coordinates"),
    "flat array": (POINTS[:, 0], r"source must have the shape \(points, 3\), but has \(3000,\)"),
    "empty": ([], "source must hold at least 4 points, but holds 0"),
    "empty array": (np.zeros((0, 3)), "source must hold at least 4 points, but holds 0"),
    "one place": (np.ones((9, 3)), "source must not all coincide"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bad_sources_are_refused_in_a_sentence(base, name):
    source, sentence = REFUSED[name]
    with pytest.raises(ValueError, match=sentence):
        jf.approximate_stream(source, base, block_size=BLOCK)


def test_a_source_that_is_traced_is_refused(base):
    with pytest.raises(TypeError, match=r"source must not be traced .* use approximate"):
        jax.jit(lambda points: jf.approximate_stream(points, base).average_error)(POINTS)


def test_a_source_that_can_be_read_only_once_is_refused(base):
    with pytest.raises(TypeError, match=r"source must be an array, .* but is a generator; pass a function"):
        jf.approximate_stream((x for x in [POINTS]), base)
    blocks = iter([POINTS])
    with pytest.raises(ValueError, match="must give the same points in every pass, but gave 3000 and then 0"):
        jf.approximate_stream(lambda: blocks, base)


NEEDS_ALL = {
    "insertion": jf.GeometricApproximation(insertion=jf.KnotInsertion()),
    "local": jf.GeometricApproximation(local=True),
    "smoothing": jf.StandardApproximation(smoothing=jf.GeneralizedCrossValidation()),
    "solver": jf.StandardApproximation(solver=jf.LevenbergMarquardt()),
    "loss": jf.StandardApproximation(loss=jf.Tukey()),
}


@pytest.mark.parametrize("name", NEEDS_ALL)
def test_options_that_need_all_points_together_are_refused(base, name):
    with pytest.raises(ValueError, match=f"the method's {name} must be .* points together; pass "):
        jf.approximate_stream(POINTS, base, NEEDS_ALL[name])


def test_methods_that_need_all_points_together_are_refused(base):
    with pytest.raises(TypeError, match=r"method must be StandardApproximation\(\) or .* Orthogonal"):
        jf.approximate_stream(POINTS, base, jf.OrthogonalDistance())
    with pytest.raises(ValueError, match="block_size must be a whole number of at least 1"):
        jf.approximate_stream(POINTS, base, block_size=0)
    with pytest.raises(ValueError, match="weights must hold one number for each of the 3000 points"):
        jf.approximate_stream(POINTS, base, weights=np.ones(7))
    with pytest.raises(TypeError, match="outside transformations"):
        jax.jit(lambda t: jf.approximate_stream(POINTS, base, tol_average=t).average_error)(1e-3)
