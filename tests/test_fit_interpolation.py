"""Geometric interpolation: it passes through the grid, and says so only when it does."""

import numpy as np
import pytest
from helpers import count_compilations, data, diagonal, eps, wavy_grid
from scipy.interpolate import BSpline

import jaxfit as jf

GRID = wavy_grid(8, 7)
PLAIN = jf.GeometricInterpolation(repositioning=jf.UnitWeights(), freeze_after=None, solve_stalled=False)
METHODS = {
    "both accelerations": jf.GeometricInterpolation(),
    "plain": PLAIN,
    "frozen feet": jf.GeometricInterpolation(repositioning=jf.UnitWeights()),
    "optimal repositioning": jf.GeometricInterpolation(freeze_after=None),
    "constant weight": jf.GeometricInterpolation(repositioning=jf.ConstantWeight(), freeze_after=None),
    "Chebyshev": jf.GeometricInterpolation(
        repositioning=jf.UnitWeights(), acceleration=jf.Chebyshev(), freeze_after=1
    ),
    "local": jf.GeometricInterpolation(local=True),
}


def tube(n, m):
    angle = np.linspace(0, 2 * np.pi, n)[:, None]
    x = np.linspace(0, 3, m)[None, :]
    parts = np.broadcast_arrays(x, np.cos(angle) * (1 + 0.1 * x), np.sin(angle))
    grid = np.stack(parts, axis=-1)
    grid[-1] = grid[0]
    return grid


@pytest.mark.float32_too
@pytest.mark.parametrize("order", [(4, 4), (3, 5)])
def test_the_surface_passes_through_every_grid_point(order):
    fit = jf.interpolate(GRID, order=order)
    assert bool(fit.converged), fit.message
    assert float(fit.maximum_error) <= (1e-12 if eps() < 1e-10 else 2e-6)
    there = np.asarray(fit.surface(fit.u, fit.v))
    assert np.abs(there - GRID).max() <= 50 * eps() + 2 * float(fit.maximum_error) * diagonal(GRID)
    assert fit.errors.shape == fit.u.shape == GRID.shape[:2]
    assert fit.surface.order == order


def test_corners_are_the_data_to_the_last_bit():
    net = np.asarray(jf.interpolate(GRID + 0.1).surface.control_points)
    for i, j in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        assert (net[i, j] == (GRID + 0.1)[i, j]).all()


@pytest.mark.parametrize("name", METHODS)
def test_every_method_meets_the_data(name):
    fit = jf.interpolate(GRID, METHODS[name])
    assert bool(fit.converged), fit.message
    there = np.asarray(fit.surface(fit.u, fit.v))
    assert np.linalg.norm(there - GRID, axis=-1).max() <= 1.1e-12 * diagonal(GRID)


def test_accelerations_take_fewer_iterations_and_evaluations():
    steps, evaluations = {}, {}
    for name in ("plain", "frozen feet", "optimal repositioning", "both accelerations", "Chebyshev"):
        fit = jf.interpolate(GRID, METHODS[name])
        steps[name] = int(fit.stats["num_steps"])
        evaluations[name] = float(fit.history.evaluations.sum())
    assert steps["optimal repositioning"] < 0.8 * steps["plain"]
    assert steps["both accelerations"] < 0.8 * steps["plain"]
    assert steps["Chebyshev"] < 0.6 * steps["both accelerations"]
    assert evaluations["frozen feet"] < 0.2 * evaluations["plain"]
    assert evaluations["both accelerations"] < 0.2 * evaluations["plain"]


def test_weights_are_equation_27():
    fit = jf.interpolate(GRID, jf.GeometricInterpolation(freeze_after=None), max_steps=1)
    first = jf.interpolate(GRID, PLAIN, max_steps=0)
    i, j, u, v = 3, 2, float(first.u[3, 2]), float(first.v[3, 2])
    ku, kv = np.asarray(first.surface.knots_u), np.asarray(first.surface.knots_v)
    nu, nv = BSpline(ku, np.eye(8), 3)(u), BSpline(kv, np.eye(7), 3)(v)
    error = GRID[i, j] - np.asarray(first.surface(u, v))
    weight = nu[i] * nv[j] / (np.sum(nu**2) * np.sum(nv**2))
    expected = GRID[i, j] + weight * error
    np.testing.assert_allclose(np.asarray(fit.surface.control_points)[i, j], expected, atol=1e-13)


def test_the_constant_weight_is_equation_17():
    fit = jf.interpolate(GRID, METHODS["constant weight"], max_steps=1)
    first = jf.interpolate(GRID, PLAIN, max_steps=0)
    lowest = 1.0
    parameters = jf.grid_parameters(GRID)
    for t, knots in zip(parameters[:2], (first.surface.knots_u, first.surface.knots_v), strict=True):
        matrix = BSpline(np.asarray(knots), np.eye(len(t)), 3)(np.asarray(t))
        lowest *= np.linalg.eigvals(matrix).real.min()
    error = GRID - np.asarray(first.surface(first.u, first.v))
    moved = np.asarray(fit.surface.control_points) - GRID
    np.testing.assert_allclose(moved[2:-2, 2:-2], 2 / (1 + lowest) * error[2:-2, 2:-2], rtol=1e-3, atol=1e-13)


def test_feet_outside_the_stencil_are_met_all_the_same():
    # Rows with very different spacing: averaged knots leave feet far from their control points.
    x = np.linspace(0, 1, 12)
    grid = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((12, 12))], axis=-1)
    for j in range(12):
        grid[:, j, 0] = x ** (0.35 if j % 2 else 2.5)
    fit = jf.interpolate(grid, max_steps=400)
    assert np.isfinite(np.asarray(fit.surface.control_points)).all()
    assert bool(fit.converged) == (float(fit.maximum_error) <= 1e-12)
    at = np.asarray(fit.surface(fit.u, fit.v))
    np.testing.assert_allclose(np.linalg.norm(at - grid, axis=-1) / diagonal(grid), fit.errors, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_symmetric_fit_meets_the_symmetrised_data_with_a_symmetric_net(axis):
    noisy = GRID + np.random.default_rng(0).normal(scale=2e-3, size=GRID.shape)
    noisy[..., axis] = noisy[..., axis] + 5.0  # the plane need not pass through the origin
    reflection = jf.Reflection(axis, normal=np.eye(3)[axis])
    fit = jf.interpolate(noisy, jf.GeometricInterpolation(symmetry=reflection))
    assert bool(fit.converged), fit.message
    fixed = reflection.located(noisy)
    net = np.asarray(fit.surface.control_points)
    assert float(fixed.asymmetry(net)) <= 1e-14 * diagonal(noisy)
    meant = np.asarray(fixed.symmetrise_points(noisy))
    met = np.asarray(fit.surface(fit.u, fit.v))
    assert np.abs(met - meant).max() <= 5e-12 * diagonal(noisy)
    freely = jf.interpolate(noisy)
    assert float(fixed.asymmetry(freely.surface.control_points)) > 1e-4
    assert int(fit.stats["num_steps"]) <= 1.1 * int(freely.stats["num_steps"])


def test_one_step_is_equations_13_and_14():
    fit = jf.interpolate(GRID, PLAIN, max_steps=1)
    parameters = jf.grid_parameters(GRID)
    knots = [jf.averaging_knots(t, 4) for t in parameters[:2]]
    first = jf.BSplineSurface(GRID, *knots)
    u, v = (x.reshape(-1) for x in np.meshgrid(parameters.u, parameters.v, indexing="ij"))
    feet = jf.closest_point(first, GRID.reshape(-1, 3), start=(u, v))
    error = (GRID.reshape(-1, 3) - np.asarray(feet.point)).reshape(GRID.shape)
    error[[0, 0, -1, -1], [0, -1, 0, -1]] = 0
    assert np.abs(np.asarray(fit.surface.control_points) - GRID - error).max() < 1e-12
    assert not bool(fit.converged)
    assert "maximum number" in fit.message


def test_history_falls_from_the_first_surface_to_the_last():
    fit = jf.interpolate(GRID)
    steps = int(fit.stats["num_steps"])
    assert len(fit.history.maximum) == len(fit.history.average) == steps + 1
    rounding = float(fit.maximum_error) - float(fit.history.maximum[-1])  # that of the net
    assert 0 <= rounding <= 2 * eps()
    assert fit.history.average[0] > 1e3 * fit.history.average[-1]


def test_a_closed_grid_has_no_seam():
    grid = tube(13, 8)
    fit = jf.interpolate(grid)
    assert bool(fit.converged), fit.message
    v = np.linspace(0, 1, 30)
    ends = [np.asarray(fit.surface(np.full(30, u), v)) for u in (0.0, 1.0)]
    assert np.abs(ends[0] - ends[1]).max() < 1e-10


@pytest.mark.parametrize("parametrisation", [jf.ChordLength(), jf.Centripetal()])
def test_far_from_the_origin_and_in_any_unit(parametrisation):
    method = jf.GeometricInterpolation(parametrisation)
    here = jf.interpolate(GRID, method)
    away = jf.interpolate(1000 * GRID + np.array([5e6, 4e5, 100.0]), method, tolerance=1e-10)
    assert bool(away.converged), away.message
    back = (np.asarray(away.surface.control_points) - np.array([5e6, 4e5, 100.0])) / 1000
    assert np.abs(back - np.asarray(here.surface.control_points)).max() < 1e-8


def test_errors_own_up_to_the_rounding_of_the_net():
    far = GRID + 5e6
    usual = jf.interpolate(far)
    assert bool(usual.converged), usual.message
    assert 1e-10 < float(usual.maximum_error) < 1e-8
    strict = jf.interpolate(far, tolerance=1e-12)
    assert strict.result == jf.RESULTS.rounded
    assert jf.interpolate(far, jf.StandardInterpolation(), tolerance=1e-12).result == jf.RESULTS.rounded


@pytest.mark.parametrize("case", ["repeated row", "collinear", "uneven"])
def test_hostile_grids_end_with_finite_numbers_and_a_reason(case):
    grid = GRID.copy()
    if case == "repeated row":
        grid[3] = grid[2]
    elif case == "collinear":
        grid = (grid[..., :1] + 0.1 * grid[..., 1:2]) * np.array([1.0, 2.0, 3.0])
    else:
        x = np.cumsum(np.r_[0, np.tile([1.0, 1e-3], 4)])[:8]
        grid[..., 0] = (x / x[-1])[:, None]
    fit = jf.interpolate(grid, max_steps=300)
    assert np.isfinite(np.asarray(fit.surface.control_points)).all()
    assert np.isfinite(float(fit.maximum_error))
    assert bool(fit.converged) == (float(fit.maximum_error) <= 1e-12)


def test_border_points_can_be_kept_on_the_border():
    grid = GRID + np.random.default_rng(2).normal(scale=1e-2, size=GRID.shape)
    fit = jf.interpolate(grid, jf.GeometricInterpolation(keep_borders=True))
    assert bool(fit.converged), fit.message
    u, v = np.asarray(fit.u), np.asarray(fit.v)
    for x, low, high in ((u, u[0], u[-1]), (v, v[:, 0], v[:, -1])):
        assert (low == x.min()).all()
        assert (high == x.max()).all()
    assert np.abs(np.asarray(fit.surface(u, v)) - grid).max() <= 5e-12 * diagonal(grid)
    free = jf.interpolate(grid)
    assert (np.asarray(free.u)[0] > 0).any()


def test_feet_may_start_at_parameters_of_their_own():
    fit = jf.interpolate(GRID, jf.GeometricInterpolation(per_point=True))
    assert bool(fit.converged), fit.message
    net, usual = fit.surface.control_points, jf.interpolate(GRID).surface.control_points
    assert np.abs(np.asarray(net) - np.asarray(usual)).max() <= 1e-10


def test_a_fit_that_grows_gives_back_the_best_surface_it_measured():
    grid = GRID.copy()
    for axis, steps in ((0, [1.0, 0.01]), (1, [0.01, 1.0])):
        x = np.cumsum(np.r_[0, np.tile(steps, 4)])[: grid.shape[axis]]
        grid[..., axis] = np.expand_dims(x / x[-1], 1 - axis)
    method = jf.GeometricInterpolation(acceleration=jf.Chebyshev(), solve_stalled=False)
    fit = jf.interpolate(grid, method, max_steps=300)
    assert fit.result == jf.RESULTS.stalled
    assert float(fit.maximum_error) < fit.history.maximum[-1]
    rounding = float(fit.maximum_error) - np.nanmin(np.asarray(fit.history.maximum))  # that of the net
    assert 0 <= rounding <= eps() * np.abs(np.asarray(fit.surface.control_points)).max() / diagonal(grid)
    at = np.asarray(fit.surface(fit.u, fit.v))
    np.testing.assert_allclose(np.linalg.norm(at - grid, axis=-1) / diagonal(grid), fit.errors, atol=1e-12)


def test_progress_reports_and_changes_nothing():
    seen = []
    watched = jf.interpolate(GRID, progress=lambda *report: seen.append(report))
    alone = jf.interpolate(GRID)
    assert (np.asarray(watched.surface.control_points) == alone.surface.control_points).all()
    assert seen[-1][0] == int(alone.stats["num_steps"])
    assert seen[-1][3] == float(alone.history.maximum[-1])


def test_a_second_grid_of_the_same_shape_compiles_nothing():
    jf.interpolate(GRID)
    with count_compilations() as compiled:
        jf.interpolate(GRID[::-1] * 2)
    assert compiled.count == 0


def test_throw_raises_the_reason():
    with pytest.raises(RuntimeError, match="maximum number of iterations"):
        jf.interpolate(GRID, max_steps=2, throw=True)


@pytest.mark.parametrize(
    ("grid", "sentence"),
    [
        (np.where(GRID[3, 3] == GRID, np.nan, GRID), "grid must be finite"),
        (GRID[:3], "grid must have at least 4 x 4 points"),
        (GRID[..., 0], "grid must have 3 dimensions"),
        (np.ones((5, 5, 3)), "must not all coincide"),
        (np.ma.masked_less(GRID, 0.1), "grid must not be masked.*leave out those points, or fill them"),
        (GRID + 1e13, "subtract their centre"),
    ],
)
def test_bad_grids_get_a_sentence(grid, sentence):
    with pytest.raises(ValueError, match=sentence):
        jf.interpolate(grid)


@pytest.mark.parametrize("tolerance", [np.inf, np.nan, -1.0])
def test_tolerances_that_are_none_get_a_sentence(tolerance):
    for method in (jf.GeometricInterpolation, jf.StandardInterpolation):
        with pytest.raises(ValueError, match="tolerance must be"):
            jf.interpolate(GRID, method(), tolerance=tolerance)
        with pytest.raises(ValueError, match="foot_tolerance must be"):
            method(foot_tolerance=tolerance)


def test_errors_of_a_symmetric_fit_say_how_far_the_data_were_from_symmetric():
    noisy = GRID + np.random.default_rng(0).normal(scale=2e-3, size=GRID.shape)
    reflection = jf.Reflection(normal=np.eye(3)[0])
    fit = jf.interpolate(noisy, jf.GeometricInterpolation(symmetry=reflection))
    expected = float(reflection.located(noisy).asymmetry(noisy)) / diagonal(noisy)
    np.testing.assert_allclose(fit.stats["asymmetry"], expected, rtol=1e-12)
    moved = np.linalg.norm(np.asarray(fit.surface(fit.u, fit.v)) - noisy, axis=-1).max() / diagonal(noisy)
    np.testing.assert_allclose(moved, expected / 2, rtol=1e-6)
    assert "measured to the symmetrised grid" in fit.message
    assert f"{100 * moved:.2g} % of the diagonal" in fit.message
    assert "other axis" not in fit.message
    wrong = jf.interpolate(
        noisy * [1, 1, 2] + 0.3 * noisy[::-1], jf.GeometricInterpolation(symmetry=jf.Reflection(axis=1))
    )
    assert "mirrored along the other axis" in wrong.message
    assert "symmetrised" not in jf.interpolate(noisy, max_steps=1).message


@pytest.mark.parametrize("method", [jf.GeometricInterpolation(), jf.StandardInterpolation(per_point=True)])
def test_any_number_of_steps_costs_no_memory(method):
    fit = jf.interpolate(GRID, method, max_steps=10**9)
    assert bool(fit.converged), fit.message
    assert len(fit.history.maximum) == int(fit.stats["num_steps"]) + 1


def test_a_hood_is_met_to_rounding():
    fit = jf.interpolate(data("hood_beetle_10x10")["grid"])
    assert bool(fit.converged), fit.message
    assert float(fit.maximum_error) <= 1e-12


@pytest.mark.float32_too
def test_a_grid_that_is_met_from_the_start_ends_at_once():
    # In single precision feet on knots may seem to lie outside their cells.
    t = np.linspace(0.0, 1.0, 30)
    grid = np.stack([*np.meshgrid(t, t, indexing="ij"), np.outer(t, t)], axis=-1)
    fit = jf.interpolate(grid, tolerance=1e-5)
    assert bool(fit.converged), fit.message
