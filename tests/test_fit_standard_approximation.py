"""Standard approximation: every round is the least-squares fit of (8), whatever solves it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations, eps, slow_except, wavy_cloud
from normal_reference import design, thin_plate_matrix

import jaxfit as jf
from jaxfit._approximation._automatic_smoothing import SmoothingCandidates
from jaxfit._approximation._linear_least_squares import StructuredSolver, least_squares_problem
from jaxfit._normal_equations import make_system
from jaxfit._splines._pieces import make_pieces

POINTS, EDGES = wavy_cloud(500)
EDGE = np.pad(np.zeros((6, 5), bool), 1, constant_values=True)  # of a net of 8 x 7
BOUNDARY = jf.Boundary(**EDGES)
SMOOTHING = 1e-3


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(BOUNDARY, net=(8, 7))


@pytest.fixture(scope="module")
def one(base):
    method = jf.StandardApproximation(smoothing=SMOOTHING)
    return jf.approximate(POINTS, base, method, max_steps=1, tol_average=1e-9)


def dense_solution(base, smoothing, corners_only=False, weights=None):
    """One round in plain NumPy, at the true feet on the base."""
    feet = jf.closest_point(base, POINTS)
    a = design(base, feet.u, feet.v)
    weights = np.ones(len(POINTS)) if weights is None else weights
    matrix = a.T @ (weights[:, None] * a) + smoothing * thin_plate_matrix(base)
    right = a.T @ (weights[:, None] * POINTS)
    before = np.asarray(base.control_points).reshape(-1, 3)
    nu, nv = base.shape
    number = np.arange(nu * nv).reshape(nu, nv)
    side = number[[0, 0, -1, -1], [0, -1, 0, -1]] if corners_only else np.r_[number[[0, -1]].ravel()]
    held = np.isin(number, side).ravel() | (not corners_only) & np.isin(number, number[:, [0, -1]]).ravel()
    after = before.copy()
    free = ~held
    right = right[free] - matrix[np.ix_(free, held)] @ before[held]
    after[free] = np.linalg.solve(matrix[np.ix_(free, free)], right)
    return after.reshape(nu, nv, 3)


def apart(fit, net):
    return np.abs(np.asarray(fit.surface.control_points) - net).max()


def test_one_round_is_the_least_squares_fit(base, one):
    assert apart(one, dense_solution(base, SMOOTHING)) < 1e-10
    assert float(one.stats["shift"]) == 0
    energy = np.asarray(one.surface.control_points).reshape(-1, 3)
    energy = np.einsum("ic,ij,jc", energy, thin_plate_matrix(base), energy)
    assert abs(float(one.stats["bending_energy"]) - energy) < 1e-9 * energy
    assert float(one.stats["smoothing"]) == SMOOTHING


def test_weights_and_a_free_boundary(base):
    weights = np.random.default_rng(1).uniform(0.1, 3, 500)
    method = jf.StandardApproximation(smoothing=SMOOTHING, border=jf.FixedCorners())
    fit = jf.approximate(POINTS, base, method, max_steps=1, tol_average=1e-9, weights=weights)
    assert apart(fit, dense_solution(base, SMOOTHING, True, weights)) < 1e-10


DRIVERS = [jf.GaussNewton(), jf.LevenbergMarquardt(), jf.JaxoptGaussNewton(), jf.JaxoptLevenbergMarquardt()]


@pytest.mark.parametrize("solver", slow_except(DRIVERS, *DRIVERS[:2]))
def test_every_driver_finds_the_same_control_points(base, one, solver):
    feet = jf.closest_point(base, POINTS)
    pieces = make_pieces(*(np.asarray(x) for x in (base.control_points, base.knots_u, base.knots_v)))

    @jax.jit
    def solved(pieces, net, u, v, points):
        system = make_system(pieces, u, v, points.T, jnp.ones_like(u), jnp.asarray(SMOOTHING))
        return solver(least_squares_problem(system, EDGE, net))[0]

    net = solved(pieces, base.control_points, feet.u, feet.v, POINTS)
    assert apart(one, np.asarray(net)) < 1e-8


def test_the_structured_solver_solves_with_the_jacobian_and_with_its_transpose(base):
    u, v = np.random.default_rng(7).random((2, 500))
    pieces = make_pieces(*(np.asarray(x) for x in (base.control_points, base.knots_u, base.knots_v)))

    @jax.jit
    def there_and_back(pieces, net, u, v, points, x):
        system = make_system(pieces, u, v, points.T, jnp.ones_like(u), jnp.asarray(SMOOTHING))
        problem = least_squares_problem(system, EDGE, net)
        x = jnp.where(problem.normal.free[:, :, None], x, 0.0)
        image = jax.jvp(problem.residual, (net,), (x,))[1]
        solver = StructuredSolver(problem)
        state = solver.init(None, {})
        across = solver.compute(solver.transpose(state, {})[0], x, {})[0]
        back = jnp.where(problem.normal.free[:, :, None], system.adjoint(across), 0.0)
        return x, solver.compute(state, image, {})[0], back

    x = np.random.default_rng(8).normal(size=(8, 7, 3))
    x, solved, transposed = there_and_back(pieces, base.control_points, u, v, POINTS, x)
    assert np.abs(np.asarray(x)).max() > 1
    assert np.abs(np.asarray(solved - x)).max() < 1e-9
    assert np.abs(np.asarray(transposed - x)).max() < 1e-9


@pytest.mark.float32_too
def test_rounds_of_parameter_correction_reach_the_tolerance(base):
    fit = jf.approximate(POINTS, base, jf.StandardApproximation(), tol_average=3e-4)
    assert bool(fit.converged), fit.message
    assert int(fit.stats["num_steps"]) < 10
    distance = np.asarray(jf.closest_point(fit.surface, POINTS).distance) / fit.stats["diagonal"]
    assert np.abs(np.asarray(fit.errors) - distance).max() < 100 * eps() + 1e-9


def test_another_smoothing_compiles_nothing(base, one):
    method = jf.StandardApproximation(smoothing=1e-6)
    with count_compilations() as compiled:
        jf.approximate(POINTS, base, method, max_steps=1, tol_average=1e-9)
    assert compiled.count == 0


def test_without_parameter_correction_one_solve_is_the_fit(base, one):
    method = jf.StandardApproximation(smoothing=SMOOTHING, parameter_correction=False)
    fit = jf.approximate(POINTS, base, method, tol_average=1e-9)
    assert fit.result == jf.RESULTS.stalled
    assert int(fit.stats["num_steps"]) == 2
    assert apart(fit, np.asarray(one.surface.control_points)) < 1e-12
    assert np.abs(np.asarray(fit.errors) - np.asarray(one.errors)).max() < 1e-9
    assert float(fit.average_error) <= float(fit.history.average[-1])


def test_without_parameter_correction_the_stall_window_stays_as_given():
    once = jf.StandardApproximation(parameter_correction=False)
    assert (once.stall_window, once.stall_after) == (20, 1)
    corrected = dataclasses.replace(once, parameter_correction=True)
    assert (corrected.stall_window, corrected.stall_after) == (20, 20)


@pytest.mark.slow
def test_without_parameter_correction_errors_are_true_distances_inside_jit_too(base):
    method = jf.StandardApproximation(smoothing=SMOOTHING, parameter_correction=False)
    options = dict(tol_average=1e-6, max_steps=1)
    fit = jax.jit(lambda points: jf.approximate(points, base, method, **options))(POINTS)
    distance = jf.closest_point(fit.surface, POINTS).distance / fit.stats["diagonal"]
    np.testing.assert_allclose(fit.errors, distance, atol=1e-9)
    outside = jf.approximate(POINTS, base, method, **options)
    assert abs(float(fit.average_error - outside.average_error)) < 1e-9


def test_a_singular_system_is_shifted_and_says_so(base):
    few = POINTS[POINTS[:, 0] < 0.5][:20]
    method = jf.StandardApproximation(smoothing=0.0)
    fit = jf.approximate(few, base, method, max_steps=1, tol_average=1e-12)
    net = np.asarray(fit.surface.control_points)
    assert float(fit.stats["shift"]) > 0
    assert np.isfinite(net).all()
    assert fit.average_error < 0.1 * fit.history.average[0]
    assert (net[-2:] == np.asarray(base.control_points)[-2:]).all()


def test_fits_in_transformations(base):
    feet = jf.closest_point(base, POINTS)
    start = (feet.u, feet.v)

    def net(points, smoothing):
        method = jf.StandardApproximation(smoothing=smoothing)
        fit = jf.approximate(points, base, method, max_steps=1, tol_average=1e-9, start=start)
        return fit.surface.control_points

    values = jnp.asarray([SMOOTHING, 1e-6])
    both = jax.jit(jax.vmap(net, in_axes=(None, 0)))(jnp.asarray(POINTS), values)
    assert np.abs(np.asarray(both[0]) - dense_solution(base, SMOOTHING)).max() < 1e-10
    assert np.abs(np.asarray(both[1]) - dense_solution(base, 1e-6)).max() < 1e-10


@pytest.mark.parametrize("value", [-1.0, np.inf, np.nan])
def test_impossible_smoothing_gets_a_sentence(value):
    with pytest.raises(ValueError, match="smoothing must be a finite number"):
        jf.StandardApproximation(smoothing=value)


def test_a_solver_of_another_kind_gets_a_sentence():
    with pytest.raises(TypeError, match="solver must be an object"):
        jf.StandardApproximation(solver="cholesky")


@pytest.mark.parametrize("solver", [jf.LevenbergMarquardt, jf.JaxoptGaussNewton, jf.JaxoptLevenbergMarquardt])
@pytest.mark.parametrize("options", [{"tolerance": -1.0}, {"max_steps": 0}])
def test_impossible_options_of_a_driver_get_a_sentence(solver, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be a"):
        solver(**options)


@pytest.mark.slow
def test_cross_validation_finds_a_smoothing_that_is_near_the_best(base):
    rng = np.random.default_rng(0)
    noisy = POINTS + 0.01 * rng.normal(size=POINTS.shape)
    options = dict(max_steps=2, tol_average=1e-9)

    def error(smoothing):
        fit = jf.approximate(noisy, base, jf.StandardApproximation(smoothing=smoothing), **options)
        distance = np.asarray(jf.closest_point(fit.surface, POINTS).distance)
        return fit, np.sqrt(np.mean(distance**2))

    least = min(error(10.0**k)[1] for k in (-5, -4, -3, -2, -1, 0))
    fit, reached = error(jf.GeneralizedCrossValidation(rounds=1))
    assert 1e-4 < float(fit.stats["smoothing"]) < 1
    assert reached < 1.3 * least


@pytest.mark.slow
def test_a_base_surface_that_follows_noise_does_not_decide_on_lambda():
    points = wavy_cloud(800)[0]
    noisy = points + 0.03 * np.random.default_rng(0).normal(size=points.shape)
    method = jf.StandardApproximation(smoothing=jf.GeneralizedCrossValidation())

    def selected(kind):
        start = jf.base_surface(BOUNDARY, noisy, net=(16, 16), method=kind)
        options = dict(max_steps=1, tol_average=1e-9, errors=jf.LocalFeet())
        return float(jf.approximate(noisy, start, method, **options).stats["smoothing"])

    assert 0.5 < selected(jf.Meshless()) / selected(jf.Coons()) < 2  # it was 1e-5


@pytest.mark.slow
def test_where_the_base_surface_is_returned_no_lambda_was_in_force(base):
    method = jf.StandardApproximation(smoothing=jf.GeneralizedCrossValidation(rounds=1))
    fit = jf.approximate(POINTS, base, method, tol_average=0.1)
    assert int(fit.stats["num_steps"]) == 0
    assert np.isnan(float(fit.stats["smoothing"]))


def test_the_discrepancy_principle_stops_at_the_noise():
    smoothing = jnp.asarray([1e-3, 1e-2, 1e-1])
    found = SmoothingCandidates(smoothing, jnp.asarray([1.0, 4.0, 16.0]), smoothing, jnp.asarray(400.0))
    assert abs(float(jf.Discrepancy(noise=0.1).best(found)) - 1e-2) < 1e-6


def test_noise_that_no_lambda_reaches_is_left_to_cross_validation():
    smoothing, effective = jnp.asarray([1e-4, 1e-3, 1e-2, 1e-1]), jnp.asarray([300.0, 200.0, 10.0, 1.0])
    found = SmoothingCandidates(smoothing, jnp.asarray([1.0, 1.0, 1.1, 16.0]), effective, jnp.asarray(400.0))
    chosen = float(jf.Discrepancy(noise=1e-3).best(found))
    assert 2e-3 < chosen < 5e-2
    assert chosen == float(jf.GeneralizedCrossValidation().best(found))


def test_impossible_rules_get_a_sentence():
    with pytest.raises(ValueError, match="noise must be"):
        jf.Discrepancy(noise=-1.0)
    with pytest.raises(ValueError, match="candidates must be"):
        jf.GeneralizedCrossValidation(candidates=2)
