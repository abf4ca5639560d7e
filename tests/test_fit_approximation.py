"""Algorithm 1, plain: each step is the paper's, errors are true distances, and nothing is NaN."""

import dataclasses
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations, data, eps, grid_edges, wavy_cloud, wavy_surface
from scipy.interpolate import BSpline

import jaxfit as jf
from jaxfit._approximation._cloud_fit import final_code, tolerances_of
from jaxfit._fit._reasons import code_of, result_of

POINTS, EDGES = wavy_cloud(500)
BOUNDARY = jf.Boundary(**EDGES)


def plain(**options):
    """Algorithm 1 as it stands, without what the default adds."""
    fields = dict(relaxation=1.0, acceleration=None, single_step=False)
    return jf.GeometricApproximation(**(fields | options))


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(BOUNDARY, net=(8, 7))


def feet_on(surface):
    feet = jf.closest_point(surface, POINTS)
    return feet.u, feet.v


def design(knots, count, u):
    """Dense matrix of basis functions, by SciPy; the right end belongs to the last span."""
    knots, u = np.asarray(knots), np.minimum(np.asarray(u), 1 - 1e-16)
    return np.stack([BSpline(knots, row, 3)(u) for row in np.eye(count)], axis=1)


def one_step(points, surface, weights=None):
    """Algorithm 1 in plain NumPy: (num / den, den) at the true feet."""
    feet = jf.closest_point(surface, points)
    nu, nv = surface.shape
    a = design(surface.knots_u, nu, feet.u)[:, :, None] * design(surface.knots_v, nv, feet.v)[:, None]
    a = a if weights is None else a * weights[:, None, None]
    den = a.sum(axis=0)
    num = np.einsum("kij,kc->ijc", a, points - np.asarray(feet.point))
    return np.where(den[..., None] > 0, num / np.where(den > 0, den, 1)[..., None], 0), den


@pytest.mark.parametrize("weighted", [False, True])
def test_one_step_is_algorithm_1(base, weighted):
    weights = np.random.default_rng(1).uniform(0.1, 3, 500) if weighted else None
    fit = jf.approximate(POINTS, base, plain(), max_steps=1, tol_average=1e-9, weights=weights)
    shift, _ = one_step(POINTS, base, weights)
    shift[[0, -1]] = shift[:, [0, -1]] = 0
    expected = np.asarray(base.control_points) + shift
    assert np.abs(np.asarray(fit.surface.control_points) - expected).max() < 1e-12


def test_a_free_boundary_moves_all_but_the_corners(base):
    method = plain(border=jf.FixedCorners())
    fit = jf.approximate(POINTS, base, method, max_steps=1, tol_average=1e-9)
    shift, _ = one_step(POINTS, base)
    shift[[0, 0, -1, -1], [0, -1, 0, -1]] = 0
    expected = np.asarray(base.control_points) + shift
    assert np.abs(np.asarray(fit.surface.control_points) - expected).max() < 1e-12


def test_relaxation_lengthens_the_move(base):
    method = plain(relaxation=1.7)
    fit = jf.approximate(POINTS, base, method, max_steps=1, tol_average=1e-9)
    shift, _ = one_step(POINTS, base)
    shift[[0, -1]] = shift[:, [0, -1]] = 0
    expected = np.asarray(base.control_points) + 1.7 * shift
    assert np.abs(np.asarray(fit.surface.control_points) - expected).max() < 1e-12


def test_relaxation_and_momentum_save_iterations(base):
    steps = [
        int(jf.approximate(POINTS, base, method, tol_average=2e-4).stats["num_steps"])
        for method in (plain(), plain(relaxation=1.7), jf.GeometricApproximation())
    ]
    assert steps[1] < 0.8 * steps[0]
    assert steps[2] < 0.8 * steps[1]


def test_momentum_is_nesterovs(base):
    rate, surfaces = 1.2, [base]
    reached, weight = np.asarray(base.control_points), 1.0
    for _ in range(4):
        before, surface = reached, surfaces[-1]
        shift, _ = one_step(POINTS, surface)
        shift[[0, -1]] = shift[:, [0, -1]] = 0
        reached = np.asarray(surface.control_points) + rate * shift
        following = (1 + np.sqrt(1 + 4 * weight**2)) / 2
        net = reached + (weight - 1) / following * (reached - before)
        weight = following
        surfaces.append(jf.BSplineSurface(net, base.knots_u, base.knots_v))
    method = plain(relaxation=rate, acceleration=jf.Nesterov())
    for steps in (2, 4):
        fit = jf.approximate(POINTS, base, method, max_steps=steps, tol_average=1e-9)
        assert (np.diff(fit.history.average) < 0).all()
        apart = np.abs(np.asarray(fit.surface.control_points - surfaces[steps].control_points)).max()
        assert apart < 1e-9


def test_momentum_stops_where_the_error_rises_and_where_the_net_is_changed(base):
    method = plain(acceleration=jf.Nesterov(), fairing=jf.Fairing(every=5))
    average = np.asarray(jf.approximate(POINTS, base, method, tol_average=1e-9, max_steps=9).history.average)
    assert (np.flatnonzero(np.diff(average) > 0) + 1).tolist() == [5]
    long = jf.approximate(POINTS, base, jf.GeometricApproximation(), tol_average=1e-9, max_steps=400)
    rises = np.flatnonzero(np.diff(long.history.average) > 0)
    assert rises.size > 0
    assert (np.diff(rises) > 1).all()  # a step from rest goes down again


def test_fairing_is_the_mean_of_nine_neighbours(base):
    unfaired = jf.approximate(POINTS, base, plain(), max_steps=1, tol_average=1e-9)
    method = plain(fairing=jf.Fairing(every=1, gamma=2.0))
    faired = jf.approximate(POINTS, base, method, max_steps=1, tol_average=1e-9)
    before, after = (np.asarray(x.surface.control_points) for x in (unfaired, faired))
    weights = np.exp(-2.0 * np.add.outer(np.abs([-1, 0, 1]), np.abs([-1, 0, 1])))
    expected = before.copy()
    for i in range(1, before.shape[0] - 1):
        for j in range(1, before.shape[1] - 1):
            around = before[i - 1 : i + 2, j - 1 : j + 2]
            expected[i, j] = np.einsum("ab,abc->c", weights, around) / weights.sum()
    assert np.abs(after - expected).max() < 1e-12


def test_fairing_comes_every_so_many_iterations(base):
    method = plain(fairing=jf.Fairing(every=5))
    fit = jf.approximate(POINTS, base, method, tol_average=1e-9, max_steps=11)
    average = np.asarray(fit.history.average)
    assert (np.flatnonzero(np.diff(average) > 0) + 1).tolist() == [5, 10]


@pytest.mark.slow
def test_fairing_a_good_base_surface_is_no_stall(base):
    nearer = jf.OrthogonalDistance(smoothing=1e-9)
    near = jf.approximate(POINTS, base, nearer, tol_average=1e-9, max_steps=100).surface
    method = plain(fairing=jf.Fairing(every=5), stall_window=10)
    fit = jf.approximate(POINTS, near, method, tol_average=1e-9, max_steps=200)
    average = np.asarray(fit.history.average)
    assert average[10] > average[0]  # no reason to end there, but that is so from one fairing to others:
    assert average[15] > average[5]
    assert int(fit.stats["num_steps"]) == 15


def test_local_mode_leaves_alone_what_is_near_enough(base):
    tolerance = 2e-3
    unmoved = jf.approximate(POINTS, base, jf.GeometricApproximation(), max_steps=0)
    near = np.asarray(unmoved.errors) <= tolerance
    assert 0.1 < near.mean() < 0.9
    method = plain(local=True)
    fit = jf.approximate(POINTS, base, method, max_steps=1, tol_average=1e-9, tol_maximum=tolerance)
    shift, (_, den) = one_step(POINTS, base)[0], one_step(POINTS[~near], base)
    shift[den == 0] = 0
    shift[[0, -1]] = shift[:, [0, -1]] = 0
    after, before = np.asarray(fit.surface.control_points), np.asarray(base.control_points)
    assert np.abs(after - before - shift).max() < 1e-12
    assert (after[den == 0] == before[den == 0]).all()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"relaxation": 2.0, "acceleration": None}, "relaxation must lie between 0 and 2"),
        ({"relaxation": 1.4}, "relaxation must lie between 0 and 1.333, where the accelerated"),
        ({"fairing": jf.Fairing(every=7)}, "stall_window must be a multiple"),
    ],
)
def test_impossible_methods_get_a_sentence(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        jf.GeometricApproximation(**options)


@pytest.mark.slow
def test_local_mode_goes_on_to_the_average_once_the_maximum_is_met(base):
    begun = jf.approximate(POINTS, base, max_steps=0)
    tolerances = dict(tol_average=0.1 * float(begun.average_error), tol_maximum=float(begun.maximum_error))
    fit = jf.approximate(POINTS, base, jf.GeometricApproximation(local=True), **tolerances)
    assert fit.converged
    assert fit.average_error <= tolerances["tol_average"]


def test_parts_of_methods_that_are_no_objects_get_a_sentence():
    # In a session of its own: here the types of fields are checked before the sentence comes.
    wrong = [
        (kind, part)
        for kind in ("GeometricApproximation", "StandardApproximation", "OrthogonalDistance")
        for part in ("insertion=True", "insertion=jf.KnotInsertion", "foot_method='newton'")
    ]
    wrong += [
        ("GeometricApproximation", f"{x}='yes'") for x in ("fairing", "acceleration", "local", "single_step")
    ]
    wrong += [("Fairing", "gamma='2'"), ("LevenbergMarquardt", "tolerance='x'")]
    lines = ["import jaxfit as jf"]
    for kind, part in wrong:
        lines += ["try:", f"    jf.{kind}({part})", "except TypeError as error:", "    print(error)"]
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=True
    )
    told = done.stdout.splitlines()
    for (_, part), line in zip(wrong, told, strict=True):
        assert line.startswith(f"{part.split('=')[0]} must be")


@pytest.mark.parametrize("options", [{"every": 0}, {"gamma": -1.0}])
def test_impossible_fairing_gets_a_sentence(options):
    with pytest.raises(ValueError, match="must be"):
        jf.Fairing(**options)


@pytest.mark.float32_too
def test_a_smooth_cloud_is_met_and_errors_are_distances_to_closest_points(base):
    fit = jf.approximate(POINTS, base, tol_average=6e-4)
    assert bool(fit.converged), fit.message
    assert float(fit.average_error) <= 6e-4
    feet = jf.closest_point(fit.surface, POINTS)
    distance = np.asarray(feet.distance) / fit.stats["diagonal"]
    assert np.abs(np.asarray(fit.errors) - distance).max() < 100 * eps() + 1e-9
    assert float(fit.maximum_error) == float(np.max(np.asarray(fit.errors)))
    assert int(fit.stats["unconverged_feet"]) == 0
    assert fit.history.average[-1] < 0.2 * fit.history.average[0]


def test_a_base_that_meets_the_tolerances_is_returned_and_said_to_be_it(base):
    fit = jf.approximate(POINTS, base, jf.StandardApproximation(smoothing=1.0), tol_average=0.5)
    assert int(fit.stats["num_steps"]) == 0
    assert np.allclose(fit.surface.control_points, base.control_points, rtol=0, atol=10 * eps())
    assert fit.message.startswith("all tolerances are met by the base surface, which is returned; lower")
    closer = jf.approximate(POINTS, base, tol_average=6e-4)
    assert closer.message == "all tolerances are met."
    grown = dataclasses.replace(fit, stats=fit.stats | {"growth_steps": 5})
    assert grown.message == "all tolerances are met."  # of a scan each net begins anew
    loops = jf.TrimmedSurface(fit.surface, (np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),))
    trimmed = dataclasses.replace(grown, trimmed=loops)
    assert "smooth surface that the fit of the last net starts from" in trimmed.message
    noisy = POINTS + 0.01 * np.random.default_rng(0).normal(size=POINTS.shape)
    rested = jf.approximate(noisy, base, tol_average=0.0)
    assert rested.result == jf.RESULTS.stalled
    assert rested.message == "the errors have stopped falling."  # there is no tolerance to loosen


def test_points_that_lie_mostly_beyond_the_border_are_told(base):
    wide = POINTS * [2.0, 2.0, 1.0] - [0.5, 0.5, 0.0]
    fit = jf.approximate(wide, base, jf.GeometricApproximation(), max_steps=0)
    assert re.match(
        r"the maximum number .* tolerances\. 9\d% of all errors .* beyond the border", fit.message
    )
    grown = dataclasses.replace(fit, result=jf.RESULTS.noise_reached)
    assert re.match(r"finer nets bring .* to the points\. 9\d% of all errors", grown.message)
    grown = dataclasses.replace(fit, result=jf.RESULTS.net_exhausted)
    assert re.search(r"number of points\. 9\d% of all errors", grown.message)  # another net is no help
    assert fit.stats["points_beyond_border"] > 300


def test_outliers_above_the_border_are_not_beyond_it(base):
    u, v = np.random.default_rng(0).uniform(size=(2, 500))
    u[:10], v[:10] = 0.01, np.linspace(0.8, 0.95, 10)
    points = np.array(base(u, v))
    points[:10, 2] += 0.3  # where the surface rises outwards: their feet are on the border
    fit = jf.approximate(points, base, jf.GeometricApproximation(), max_steps=0, tol_average=1e-4)
    assert (np.asarray(fit.u)[:10] == 0).all()
    assert fit.stats["points_beyond_border"] == 0
    assert "100% of all errors are those of 5% of the points; if these are outliers" in fit.message
    assert "or pass a method with loss=Tukey()." in fit.message
    rested = dataclasses.replace(fit, result=jf.RESULTS.net_exhausted)
    assert "pass a net" not in rested.message
    robust = jf.GeometricApproximation(loss=jf.Tukey())
    robust = jf.approximate(points, base, robust, max_steps=0, tol_average=1e-4)
    assert robust.stats["loss"] == "Tukey"
    assert robust.message.endswith("if these are outliers, judge the surface by the others.")
    weights = np.where(np.arange(500) < 10, 0.0, 1.0)
    counted = jf.approximate(
        points, base, jf.GeometricApproximation(), max_steps=0, tol_average=0, weights=weights
    )
    assert "outliers" not in counted.message


def test_a_fit_that_leaves_a_nearer_surface_says_so(base):
    points = np.array(base(*np.random.default_rng(0).uniform(0.1, 0.9, (2, 500))))
    points[:10, 2] += 0.3
    before, fit = (jf.approximate(points, base, max_steps=n, tol_average=1e-5) for n in (0, 5))
    assert fit.average_error > before.average_error
    said = f"The surface that it started from is nearer on average ({100 * before.average_error:.3g} %)."
    assert said in fit.message
    assert "nearer on average" not in before.message
    robust = jf.approximate(
        points, base, jf.OrthogonalDistance(loss=jf.Tukey()), max_steps=5, tol_average=1e-5
    )
    assert "nearer on average" not in robust.message


def test_held_and_untouched_control_points_keep_every_bit(base):
    surface = base.affine(np.eye(3), np.array([0.1, 0.2, 0.3]))
    some = POINTS[(POINTS[:, 0] < 0.3) & (POINTS[:, 1] < 0.4)] + np.array([0.1, 0.2, 0.3])
    fit = jf.approximate(some, surface, jf.GeometricApproximation(), max_steps=3, tol_average=1e-9)
    before, after = np.asarray(surface.control_points), np.asarray(fit.surface.control_points)
    for held in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        assert (before[held] == after[held]).all()
    far = np.s_[-3:, -3:]
    assert (before[far] == after[far]).all()
    assert np.abs(before - after).max() > 1e-4


def test_points_of_weight_zero_do_not_pull(base):
    outlier = np.concatenate([POINTS, [[0.5, 0.5, 3.0]]])
    weights = np.r_[np.ones(500), 0.0]
    options = dict(max_steps=4, tol_average=1e-9)
    with_it = jf.approximate(outlier, base, jf.GeometricApproximation(), weights=weights, **options)
    without = jf.approximate(POINTS, base, jf.GeometricApproximation(), **options)
    difference = with_it.surface.control_points - without.surface.control_points
    assert np.abs(np.asarray(difference)).max() < 1e-12
    assert float(with_it.errors[-1]) > 0.5
    assert float(with_it.maximum_error) < 0.01  # of the points that count


def test_the_order_of_the_points_does_not_matter(base):
    options = dict(max_steps=5, tol_average=1e-9)
    mixed = jf.approximate(POINTS[::-1], base, jf.GeometricApproximation(), **options)
    plain = jf.approximate(POINTS, base, jf.GeometricApproximation(), **options)
    difference = mixed.surface.control_points - plain.surface.control_points
    assert np.abs(np.asarray(difference)).max() < 1e-12
    assert np.abs(np.asarray(mixed.errors)[::-1] - np.asarray(plain.errors)).max() < 1e-12


def test_motion_and_scale_of_the_problem_move_and_scale_the_fit(base):
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    matrix, offset = 250.0 * turn, np.array([5e5, -3e5, 1e4])
    options = dict(max_steps=5, tol_average=1e-9)
    plain = jf.approximate(POINTS, base, jf.GeometricApproximation(), **options).surface.affine(
        matrix, offset
    )
    moved = jf.approximate(
        POINTS @ matrix.T + offset, base.affine(matrix, offset), jf.GeometricApproximation(), **options
    )
    difference = np.asarray(moved.surface.control_points) - np.asarray(plain.control_points)
    assert np.abs(difference).max() < 1e-9 * 250 * 1.5


def test_samples_of_the_surface_leave_it_as_it_is():
    surface = wavy_surface(8, 7)
    u, v = np.random.default_rng(5).random((2, 500))
    fit = jf.approximate(np.asarray(surface(u, v)), surface, tol_average=1e-12)
    assert bool(fit.converged), fit.message
    assert int(fit.stats["num_steps"]) == 0
    assert np.abs(np.asarray(fit.surface.control_points - surface.control_points)).max() < 1e-15


def test_smoothing_a_surface_that_meets_the_points_is_no_divergence():
    surface = wavy_surface(8, 7)
    points = np.asarray(surface(*np.random.default_rng(5).random((2, 500))))
    method = jf.StandardApproximation(smoothing=1e-2, parameter_correction=False)
    fit = jf.approximate(points, surface, method, tol_average=0.0)
    assert fit.result == jf.RESULTS.stalled
    assert 1e-5 < float(fit.average_error) < 0.1


def test_the_reason_why_a_final_surface_misses_what_was_met():
    goal = tolerances_of(1e-3, 1e-2, 5)
    converged = code_of(jf.RESULTS.converged)
    cases = {
        (1e-3, 1e-2): jf.RESULTS.converged,
        (1.1e-3, 1e-2): jf.RESULTS.rounded,
        (1e-3, 1.1e-2): jf.RESULTS.stalled,
    }
    for errors, result in cases.items():
        assert result_of(final_code(converged, errors, 2e-4, goal)) == result
    stopped = code_of(jf.RESULTS.max_steps_reached)
    assert final_code(stopped, (1.0, 1.0), 0.0, goal) == stopped
    stalled = code_of(jf.RESULTS.stalled)
    assert final_code(stalled, (1.0, 1.0), 1e-4, goal) == stalled
    assert result_of(final_code(stalled, (1.0, 1.0), 2e-3, goal)) == jf.RESULTS.rounded
    any_error = tolerances_of(0.0, None, 5)
    assert final_code(stalled, (1.0, 1.0), 2e-3, any_error) == stalled


def test_a_tolerance_out_of_reach_ends_as_stalled(base):
    rough = POINTS + 0.01 * np.random.default_rng(2).normal(size=POINTS.shape)
    fit = jf.approximate(rough, base, tol_average=1e-9, max_steps=1000)
    assert fit.result == jf.RESULTS.stalled
    assert not bool(fit.converged)
    assert int(fit.stats["num_steps"]) < 1000


def test_vmap_inside_jit_gives_the_same_as_plain_calls(base):
    start = feet_on(base)

    def net(points):
        fit = jf.approximate(
            points, base, jf.GeometricApproximation(), max_steps=3, tol_average=1e-9, start=start
        )
        return fit.surface.control_points, fit.average_error

    clouds = jnp.stack([jnp.asarray(POINTS), jnp.asarray(POINTS) * jnp.asarray([[1, 1, 0.5]])])
    both, averages = jax.jit(jax.vmap(net))(clouds)
    for k in range(2):
        plain, average = net(np.asarray(clouds[k]))
        assert np.abs(np.asarray(both[k] - plain)).max() < 1e-12
        assert abs(float(averages[k] - average)) < 1e-12


def test_a_second_cloud_of_similar_size_compiles_nothing(base):
    jf.approximate(POINTS, base, max_steps=5)
    with count_compilations() as compiled:
        jf.approximate(POINTS[:-10], base, max_steps=7, tol_average=3e-4)
    assert compiled.count == 0


@pytest.mark.slow
def test_the_whole_way_from_a_cloud_with_its_boundary():
    fit = jf.fit_points(POINTS, BOUNDARY, tol_average=1e-3)
    assert bool(fit.converged), fit.message
    same = jf.fit_points(POINTS, BOUNDARY, net=(8, 7), tol_average=1e-3)
    assert same.surface.shape == (8, 7)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"points": np.where(POINTS[7] == POINTS, np.nan, POINTS)}, "points must be finite"),
        ({"points": POINTS[:, :2]}, "points must have 3 coordinates"),
        ({"points": POINTS[:3]}, "points must hold at least 4 points"),
        ({"points": np.ones((9, 3))}, "must not all coincide"),
        ({"weights": np.ones(3)}, "weights must hold one number for each"),
        ({"weights": -np.ones(500)}, "weights must not be negative"),
        ({"start": (np.zeros(3), np.zeros(3))}, "start must hold a u and a v for each"),
        ({"start": np.zeros(500)}, "start must be a pair"),
        ({"start": (np.full(500, 0.5), np.full(500, 7.0))}, "start v must lie in the domain"),
    ],
)
def test_bad_input_gets_a_sentence(base, change, sentence):
    arguments = {"points": POINTS, "base": base} | change
    with pytest.raises(ValueError, match=sentence):
        jf.approximate(**arguments)


def test_what_a_fit_cannot_do_is_said_before_there_is_a_base_surface(monkeypatch):
    monkeypatch.setattr("jaxfit._approximation._fit_points.default_base", None)
    for change, sentence in (
        ({"points": np.ones((9, 3))}, "must not all coincide"),
        ({"points": POINTS[:, :2]}, "points must have 3 coordinates"),
        ({"weights": -np.ones(500)}, "weights must not be negative"),
        ({"max_steps": -1}, "max_steps must be"),
    ):
        with pytest.raises(ValueError, match=sentence):
            jf.fit_points(**({"points": POINTS, "boundary": BOUNDARY} | change))


def test_an_option_that_there_is_none_gets_a_sentence():
    with pytest.raises(TypeError, match=r"tolerance is not an option .* pass any of boundary, .*tol_average"):
        jf.fit_points(POINTS, BOUNDARY, tolerance=1e-4)


@pytest.mark.slow
def test_a_real_scan_is_fitted_from_its_boundary():
    arrays = data("igea_face")
    sides = {key[-2:]: arrays[key] for key in arrays if key.startswith("boundary_")}
    some, options = arrays["points"][::4], dict(net=(24, 24), max_steps=15, tol_average=1e-4)
    fit = jf.fit_points(some, jf.Boundary(**sides), **options)
    assert float(fit.average_error) < 5.5e-4
    assert fit.history.average[-1] < fit.history.average[0]
    assert np.isfinite(np.asarray(fit.surface.control_points)).all()


@pytest.mark.slow
def test_a_grid_taken_as_a_cloud():
    grid = data("fran_face_45x49")["grid"]
    boundary = jf.Boundary(**grid_edges(grid))
    fit = jf.fit_points(grid.reshape(-1, 3), boundary, net=(20, 20), max_steps=30)
    assert float(fit.average_error) < 2e-3
