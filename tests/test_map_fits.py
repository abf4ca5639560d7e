"""Many fits in one call: the same fits as one by one, whoever computes them."""

import os
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_except, wavy_cloud

import jaxfit as jf
from jaxfit._batch import _map_fits
from jaxfit._cores import cores
from jaxfit.io import PointData

SIZES = (300, 260, 290)
CLOUDS = [wavy_cloud(n, seed=n)[0] + [0, 0, 0.01 * i] for i, n in enumerate(SIZES)]
BASE = jf.base_surface(jf.Boundary(**wavy_cloud(4)[1]), net=(6, 6))
OTHER = jf.base_surface(jf.Boundary(**wavy_cloud(4, height=0.2)[1]), net=(6, 6))
OPTIONS = {"tol_average": 0.0, "max_steps": 4}
METHODS = [jf.GeometricApproximation(), jf.StandardApproximation(smoothing=1e-5), jf.OrthogonalDistance(1e-7)]


def name(method):
    return type(method).__name__


def assert_same(fit, other):
    for a, b in zip(jax.tree.leaves(fit), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("method", slow_except(METHODS, *METHODS[:2]), ids=name)
def test_ragged_clouds_are_fitted_as_one_by_one(method):
    fits = jf.map_fits(CLOUDS, BASE, method, **OPTIONS)
    for cloud, fit in zip(CLOUDS, fits, strict=True):
        assert_same(fit, jf.approximate(cloud, BASE, method, **OPTIONS))


@pytest.mark.float32_too
@pytest.mark.filterwarnings("ignore:the tolerance 0 is beyond float32")
def test_a_cloud_that_is_not_finite_fails_alone():
    bad = np.array(CLOUDS[1])
    bad[7, 2] = np.nan
    endless = jf.map_fits([bad * np.inf, CLOUDS[2]], BASE, **OPTIONS)
    assert [bool(np.isfinite(fit.average_error)) for fit in endless] == [False, True]
    fits = jf.map_fits(
        [CLOUDS[0], bad, CLOUDS[2]], BASE, **{**OPTIONS, "max_steps": jnp.asarray(OPTIONS["max_steps"])}
    )
    alone = jf.map_fits(CLOUDS, BASE, **OPTIONS)
    assert_same((fits[0], fits[2]), (alone[0], alone[2]))
    said = "nothing was fitted: points must be finite, but 1 of its 780 entries are NaN or infinite"
    assert fits[1].message.startswith(said)
    assert not bool(fits[1].converged)
    assert np.isnan(fits[1].average_error)
    assert np.isnan(fits[1].errors).all()
    assert fits[1].errors.shape == bad.shape[:1]
    assert said in str(fits[1])
    with pytest.raises(RuntimeError, match="did not converge"):
        jf.map_fits([bad], BASE, throw=True, **OPTIONS)


@pytest.mark.parametrize(
    ("cloud", "weights", "said"),
    [
        (CLOUDS[1][:, :2], None, "points must have 3 coordinates a row, but has 2; give one row per point."),
        (CLOUDS[1][:3], None, "points must hold at least 4 points, but has shape (3, 3)"),
        (np.zeros((0, 3)), None, "points must hold at least 4 points, but has shape (0, 3)"),
        (np.float64(1.0), None, "points must have 2 dimensions, but has shape ()"),
        (0 * CLOUDS[1], None, "points must not all coincide"),
        (CLOUDS[1], np.ones(3), "weights must hold one number for each of the 260 points"),
        (CLOUDS[1], -np.ones(260), "weights must not be negative"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_cloud_that_cannot_be_fitted_fails_alone(cloud, weights, said):
    every = None if weights is None else [np.ones(len(CLOUDS[0])), weights]
    fits = jf.map_fits([CLOUDS[0], cloud], BASE, weights=every, **OPTIONS)
    assert_same(fits[0], jf.map_fits(CLOUDS[:1], BASE, weights=every and every[:1], **OPTIONS)[0])
    assert fits[1].message.startswith(f"nothing was fitted: {said}")
    assert not bool(fits[1].converged)
    assert fits[1].surface is BASE
    assert said in str(fits[1])


def test_fits_that_fail_have_the_stats_of_others():
    bad = np.full_like(CLOUDS[0], np.nan)
    (failed,) = jf.map_fits([bad], BASE, tol_average=None, tol_maximum=0.01)
    assert (float(failed.stats["tol_average"]), float(failed.stats["tol_maximum"])) == (np.inf, 0.01)
    assert (failed.stats["num_steps"], failed.stats["method"]) == (0, "OrthogonalDistance")
    (failed,) = jf.map_fits([bad], BASE)
    assert (float(failed.stats["tol_average"]), float(failed.stats["tol_maximum"])) == (6e-4, np.inf)


def test_clouds_may_be_what_was_read_from_files():
    bad = [PointData(np.full_like(cloud, np.nan), None, None, "scan") for cloud in CLOUDS]
    assert [len(fit.errors) for fit in jf.map_fits(bad, BASE)] == list(SIZES)
    assert [len(fit.errors) for fit in jf.map_fits(bad[0], [BASE, OTHER])] == [SIZES[0]] * 2


def test_bases_lambdas_and_weights_may_differ():
    bases, lambdas = [BASE, OTHER], [1e-4, 1e-6]
    methods = [jf.StandardApproximation(smoothing=x) for x in lambdas]
    weights = np.random.default_rng(0).uniform(0.5, 1, (2, SIZES[0]))
    fits = jf.map_fits(CLOUDS[0], bases, methods, weights, **OPTIONS)
    for i, fit in enumerate(fits):
        assert_same(fit, jf.approximate(CLOUDS[0], bases[i], methods[i], weights=weights[i], **OPTIONS))
        assert float(fit.stats["smoothing"]) == lambdas[i]


@pytest.mark.parametrize(("granted", "expected"), [("2", 2), ("64", 3), ("0", 3), ("some", 3), (None, 3)])
def test_threads_are_as_many_as_cores_are_granted(monkeypatch, granted, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 5}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.delenv("NPROC", raising=False)
    if granted is not None:
        monkeypatch.setenv("NPROC", granted)
    assert cores() == expected


def test_any_executor_computes():
    with ThreadPoolExecutor(2) as executor:
        fits = jf.map_fits(CLOUDS, BASE, executor=executor, **OPTIONS)
    assert_same(fits, jf.map_fits(CLOUDS, BASE, **OPTIONS))


def test_workers_get_fewer_and_fewer_fits_at_once():
    class Noting(ThreadPoolExecutor):
        def submit(self, function, /, *args, **kwargs):
            sizes.extend(len(x) for x in args[:1])
            return super().submit(function, *args, **kwargs)

    sizes = []
    with Noting(2) as executor:
        jf.map_fits([CLOUDS[0]] * 40, BASE, jf.StandardApproximation(), executor=executor, max_steps=0)
    assert sum(sizes) == 40
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > 1
    assert sizes[-4:] == [1, 1, 1, 1]


@pytest.mark.parametrize("method", slow_except(METHODS, *METHODS[:2]), ids=name)
def test_padding_has_no_influence(method):
    def fitted(cloud, weights):
        fit = jf.approximate(cloud, BASE, method, weights=weights, **OPTIONS)
        return fit.surface.control_points, fit.average_error, fit.maximum_error, fit.history.average[:5]

    points, weights = jf.pad_clouds(CLOUDS)
    assert points.shape[1] > max(SIZES)
    for i, cloud in enumerate(CLOUDS):
        for a, b in zip(fitted(cloud, None), fitted(points[i], weights[i]), strict=True):
            np.testing.assert_allclose(b, a, rtol=0, atol=1e-12)


def test_padding_has_no_influence_inside_a_program():
    points, weights = jf.pad_clouds(CLOUDS)
    points = np.where(weights[..., None] > 0, points, points + 0.5)  # wherever the padding lies

    @jax.jit
    def fitted(points, weights):
        fits = jf.map_fits(points, BASE, METHODS[0], weights, **OPTIONS)
        return [(fit.surface.control_points, fit.average_error, fit.maximum_error) for fit in fits]

    for cloud, found in zip(CLOUDS, fitted(points, weights), strict=True):
        alone = jf.approximate(cloud, BASE, METHODS[0], **OPTIONS)
        expected = alone.surface.control_points, alone.average_error, alone.maximum_error
        for a, b in zip(expected, found, strict=True):
            np.testing.assert_allclose(b, a, rtol=0, atol=1e-12)


def test_closest_points_of_a_cloud_that_is_not_finite_come_to_an_end():
    bad = np.array(CLOUDS[0][:20])
    bad[3] = np.nan
    found = jax.jit(lambda points: jf.closest_point(BASE, points))(bad)
    assert not np.asarray(found.converged).any()


def test_inside_a_transformation_the_fits_are_one_program():
    points, weights = jf.pad_clouds(CLOUDS)
    points[1, 3, 0] = np.nan
    methods = [jf.StandardApproximation(smoothing=x) for x in (1e-4, 1e-5, 1e-6)]

    @jax.jit
    def fitted(points, weights):
        return jf.map_fits(points, BASE, methods, weights, **OPTIONS)

    fits = fitted(points, weights)
    for i in (0, 2):
        alone = jf.approximate(CLOUDS[i], BASE, methods[i], **OPTIONS)
        np.testing.assert_allclose(
            fits[i].surface.control_points, alone.surface.control_points, rtol=0, atol=1e-10
        )
    assert [bool(jnp.isfinite(fit.average_error)) for fit in fits] == [True, False, True]
    assert not bool(fits[1].converged)
    assert jnp.isnan(fits[1].maximum_error)
    np.testing.assert_array_equal(fits[1].surface.control_points, BASE.control_points)


def test_a_net_with_room_for_knots_keeps_its_base_where_a_cloud_is_not_finite():
    method = jf.GeometricApproximation(insertion=jf.KnotInsertion())
    points = np.where(np.arange(len(CLOUDS[0]))[:, None] == 3, np.nan, CLOUDS[0])
    fit = jax.jit(lambda x: jf.approximate(x, BASE, method, max_steps=40))(points)
    (nu, nv), net = BASE.shape, np.asarray(fit.surface.control_points)
    assert net.shape != BASE.control_points.shape
    assert np.isfinite(net).all()
    np.testing.assert_array_equal(net[:nu, :nv], BASE.control_points)
    np.testing.assert_allclose(fit.surface(0.3, 0.6), BASE(0.3, 0.6), atol=1e-12)
    assert not bool(fit.converged)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((CLOUDS[0], BASE), "use approximate for a single fit"),
        ((CLOUDS, [BASE, BASE]), "{'clouds': 3, 'base': 2}"),
    ],
)
def test_bad_lists_get_a_sentence(arguments, said):
    with pytest.raises(ValueError, match=said):
        jf.map_fits(*arguments, **OPTIONS)


@pytest.mark.parametrize(
    ("method", "options", "said"),
    [
        (None, {"adjoint": "implicit"}, "adjoint must be an object such as"),
        (jf.GeometricInterpolation(), {}, "is one for grids; call interpolate"),
        (None, {"max_steps": -1}, "max_steps must be"),
        (None, {"errors": jf.GlobalFeet}, "errors must be an object such as"),
    ],
)
def test_options_and_methods_are_checked_before_any_fit(monkeypatch, method, options, said):
    monkeypatch.setattr(_map_fits, "_fit_group", lambda *_: pytest.fail("a fit was begun"))
    for cloud in (CLOUDS[0], np.full_like(CLOUDS[0], np.nan)):
        with pytest.raises((TypeError, ValueError), match=said):
            jf.map_fits([cloud], BASE, method, **options)


def test_names_and_sizes_get_a_sentence():
    with pytest.raises(TypeError, match="progress is not an option of map_fits; pass any of tol_average"):
        jf.map_fits(CLOUDS, BASE, progress=print)
    with pytest.raises(TypeError, match=r"clouds\[0\]: points must hold real numbers, but has dtype"):
        jf.map_fits([np.full((4, 3), "x")], BASE)
    with pytest.raises(ValueError, match="clouds must hold at least one cloud"):
        jf.pad_clouds([])
    for clouds, kind in (({"a": CLOUDS[0]}, "dict"), ((x for x in CLOUDS), "generator")):
        with pytest.raises(TypeError, match=f"clouds must be a list of arrays, but is a {kind}"):
            jf.map_fits(clouds, BASE)
    with pytest.raises(TypeError, match="executor must be an object such as worker_processes"):
        jf.map_fits(CLOUDS, BASE, executor="processes")
    with pytest.raises(ValueError, match="weights must hold one number for each point"):
        jf.pad_clouds(CLOUDS, CLOUDS)
    weights = [np.ones(len(cloud)) for cloud in CLOUDS]
    for i, wrong, said in ((0, -1.0, "must not be negative"), (2, np.nan, "must be finite")):
        with pytest.raises(ValueError, match=rf"weights\[{i}\] {said}"):
            jf.pad_clouds(CLOUDS, [np.where(i == k, wrong, x) for k, x in enumerate(weights)])
    with pytest.raises(ValueError, match=r"clouds\[1\] is no array \(points, d\) of numbers"):
        jf.pad_clouds([CLOUDS[0], [[0, 1], [2]]])
    with pytest.raises(ValueError, match="see pad_clouds"):
        jax.jit(lambda cloud: jf.map_fits([cloud, CLOUDS[1]], BASE)[0].average_error)(CLOUDS[0])
    with pytest.raises(ValueError, match="workers must be a whole number of at least 1, but is 0"):
        jf.worker_processes(0).__enter__()
