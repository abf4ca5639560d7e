"""Orthogonal distance: its rows are the derivative of the true distances, and no step makes them worse."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import clamped_uniform, data, diagonal, eps, wavy_cloud
from normal_reference import thin_plate_matrix

import jaxfit as jf
from jaxfit._approximation._damping import (
    LEAST_DAMPING,
    SMALL,
    USUAL_DAMPING,
    DampingState,
    actual_gain,
    is_no_worse,
    longest_moves,
    next_damping,
    within_reach,
)
from jaxfit._approximation._distance_rows import normal_equations, rows_with_influence
from jaxfit._approximation._second_order_correction import second_order_rhs
from jaxfit._fit._problem import Tolerances, make_problem
from jaxfit._fit._scaling import unit_of
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._normal_equations import _coupled_preconditioner, coupled_preconditioner, solve_coupled
from jaxfit._splines._pieces import pieces_on

POINTS, EDGES = wavy_cloud(500)
BOUNDARY = jf.Boundary(**EDGES)
SMOOTHING = 1e-6  # against the sum over the points
MEAN = SMOOTHING / len(POINTS)  # and against their mean


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(BOUNDARY, net=(8, 7))


@pytest.fixture(scope="module")
def fit(base):
    method = jf.OrthogonalDistance(smoothing=MEAN)
    return jf.approximate(POINTS, base, method, max_steps=8, tol_average=1e-9)


@pytest.fixture(scope="module")
def laid_out(base):
    """A problem with some points beyond the border, feet on the base, and the normal equations there."""
    cloud = POINTS.copy()
    cloud[:40, 0] -= 1.1 * cloud[:40, 0] + 0.02
    cloud[:, 2] += 0.05
    unit = unit_of(cloud)
    problem = make_problem(cloud, None, unit, Tolerances(*np.full(2, np.inf), np.int32(1)))
    net = jnp.asarray(unit.inward(base.control_points))
    axes = jax.tree.map(jnp.asarray, WorkingSurface.of(net, base.knots_u, base.knots_v).axes)
    feet = jf.closest_point(jf.BSplineSurface(net, base.knots_u, base.knots_v), unit.inward(cloud))
    pad = problem.target.shape[1] - len(cloud)
    u, v = (jnp.pad(x, (0, pad)) for x in (feet.u, feet.v))

    @jax.jit
    def compute(problem, net, u, v, weight, mu):
        pieces = pieces_on(net, *axes)
        rows = rows_with_influence(pieces, u, v, weight)
        return normal_equations(problem, pieces, rows, u, v, weight, mu)

    def rows(mu, counts=1.0):
        weight = jnp.pad(counts * jnp.ones(len(cloud)), (0, pad))
        return compute(problem, net, u, v, weight, jnp.asarray(mu))

    return problem, net, feet, rows


def distances(problem, net, base, feet):
    """|Q_k - R(u*_k)|, feet being found anew."""
    surface = jf.BSplineSurface(net, base.knots_u, base.knots_v)
    return jf.closest_point(surface, problem.target.T[: feet.u.shape[0]], start=(feet.u, feet.v)).distance


def slope(problem, net, base, feet, along):
    """d |Q_k - R(u*_k)| along a change of the net, by central differences."""
    ahead, behind = (distances(problem, net + h * along, base, feet) for h in (1e-5, -1e-5))
    return (ahead - behind) / 2e-5


def test_gradient_and_normal_matrix_are_those_of_the_true_distances(base, laid_out):
    problem, net, feet, rows = laid_out
    inside = (feet.u > 0) & (feet.u < 1) & (feet.v > 0) & (feet.v < 1)
    assert 0 < int(jnp.sum(~inside)) < 100
    every, inner = rows(0.0), rows(0.0, inside)
    for seed in range(3):
        along = jnp.asarray(np.random.default_rng(seed).normal(size=net.shape))
        change = slope(problem, net, base, feet, along)
        fall = -jnp.sum(feet.distance * change)
        assert abs(float(jnp.sum(every.gradient * along) / fall) - 1) < 1e-6
        # In the normal space of a point beyond the border lies more than its distance.
        square, most = (float(jnp.sum(along * x.matrix(along))) for x in (inner, every))
        assert abs(square / float(jnp.sum((inside * change) ** 2)) - 1) < 1e-6
        assert most > float(jnp.sum(change**2))


def test_second_derivatives_along_a_move_are_those_of_the_true_distances(base, laid_out):
    problem, net, feet, _ = laid_out
    inside = (feet.u > 0) & (feet.u < 1) & (feet.v > 0) & (feet.v < 1)
    pad = problem.target.shape[1] - len(inside)
    points = [jnp.pad(x, (0, pad)) for x in (feet.u, feet.v, 1.0 * inside)]
    move, along = np.random.default_rng(3).normal(size=(2, *net.shape))
    axes = jax.tree.map(jnp.asarray, WorkingSurface.of(net, base.knots_u, base.knots_v).axes)
    pieces, moves = (pieces_on(x, *axes) for x in (net, jnp.asarray(move)))
    rows = rows_with_influence(pieces, *points)
    pull = jax.jit(second_order_rhs)(problem, pieces, moves, rows, *points)
    ahead, here, behind = (distances(problem, net + h * move, base, feet) for h in (2e-4, 0.0, -2e-4))
    bent = (ahead - 2 * here + behind) / 4e-8
    expected = -0.5 * jnp.sum(inside * bent * slope(problem, net, base, feet, along))
    assert abs(float(jnp.sum(pull * along) / expected) - 1) < 1e-3


def test_full_damping_is_the_matrix_at_fixed_parameters(laid_out):
    _, _, _, rows = laid_out
    got = rows(1.0).matrix
    expected = jnp.eye(3)[:, :, None, None, None, None] * got.entries[0, 0][None, None]
    assert np.abs(np.asarray(got.entries - expected)).max() < 1e-12


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("factored", [False, True], ids=["large net", "small net"])
def test_the_coupled_system_is_solved(laid_out, factored, turned, monkeypatch):
    monkeypatch.setattr(_coupled_preconditioner, "FACTORED_SIDE", 24 if factored else 0)
    _, net, _, rows = laid_out
    got = rows(0.1)
    matrix, right = got.matrix, got.gradient
    if turned:
        matrix, right, net = matrix.with_directions_swapped(), right.swapaxes(0, 1), net.swapaxes(0, 1)
    free = jnp.zeros(net.shape[:2], bool).at[1:-1, 1:-1].set(True)
    near = coupled_preconditioner(matrix, matrix.trace, free)
    solution = jax.jit(lambda m, r: solve_coupled(m, r, free, near, 1e-12, 500))(matrix, right)
    number = np.arange(net.size).reshape(net.shape)[1:-1, 1:-1].ravel()
    dense = np.asarray(matrix.dense())[np.ix_(number, number)]
    exact = np.linalg.solve(dense, np.asarray(right).reshape(-1)[number])
    assert np.abs(np.asarray(solution.net).reshape(-1)[number] - exact).max() < 1e-8 * np.abs(exact).max()
    assert not np.asarray(solution.net)[0].any()
    if factored:
        direct = near(right)
        assert np.abs(np.asarray(direct).reshape(-1)[number] - exact).max() < 1e-10 * np.abs(exact).max()
        assert int(solution.steps) <= 2


def objective(fit, surface, errors):
    net = np.asarray(surface.control_points).reshape(-1, 3)
    bending = SMOOTHING * np.einsum("ic,ij,jc", net, thin_plate_matrix(surface), net)
    return np.sum((np.asarray(errors) * float(fit.stats["diagonal"])) ** 2) + bending


@pytest.mark.slow
def test_optimistix_comes_to_the_same_minimum(base):
    nearest = jf.closest_point(base, POINTS)
    feet = (nearest.u, nearest.v)
    method = jf.OrthogonalDistance(smoothing=MEAN)
    fit = jf.approximate(POINTS, base, method, tol_average=1e-9, max_steps=60)
    values, vectors = np.linalg.eigh(np.asarray(thin_plate_matrix(base)))
    root = jnp.asarray((vectors * np.sqrt(SMOOTHING * np.maximum(values, 0))).T)

    def residual(inner, feet):
        net = base.control_points.at[1:-1, 1:-1].set(inner)
        surface = jf.BSplineSurface(net, base.knots_u, base.knots_v)
        return POINTS - jf.closest_point(surface, POINTS, start=feet).point, root @ net.reshape(-1, 3)

    def objective(inner):
        return float(sum(jnp.sum(x**2) for x in residual(inner, feet)))

    begun, mine = (x.control_points[1:-1, 1:-1] for x in (base, fit.surface))
    solver = optx.LevenbergMarquardt(1e-6, 1e-8)
    theirs = optx.least_squares(residual, solver, begun, feet, max_steps=30, throw=False).value
    assert objective(theirs) < 1e-2 * objective(begun)
    assert abs(objective(mine) / objective(theirs) - 1) < 0.02


def test_the_objective_falls_below_that_of_standard_approximation(base, fit):
    standard = jf.approximate(
        POINTS, base, jf.StandardApproximation(smoothing=SMOOTHING), max_steps=8, tol_average=1e-9
    )
    mine, other = (objective(x, x.surface, x.errors) for x in (fit, standard))
    assert mine < 0.9 * other
    net = np.asarray(fit.surface.control_points).reshape(-1, 3)
    energy = np.einsum("ic,ij,jc", net, thin_plate_matrix(fit.surface), net)
    assert abs(float(fit.stats["bending_energy"]) - energy) < 1e-9 * energy
    assert float(fit.stats["smoothing"]) == MEAN
    assert fit.stats["method"] == "OrthogonalDistance"
    before, after = (np.asarray(x.control_points) for x in (base, fit.surface))
    assert (before[[0, -1]] == after[[0, -1]]).all()
    assert (before[:, [0, -1]] == after[:, [0, -1]]).all()


@pytest.mark.slow
def test_no_step_is_kept_that_makes_the_distances_worse(base):
    method = jf.OrthogonalDistance(smoothing=0.0, damping=1e-6, reach=50.0, stall_gain=0.0)
    few = np.repeat([1.0, 0.0], [120, len(POINTS) - 120])
    last = np.inf
    for steps in (1, 2, 3, 4, 6, 9, 30):
        got = jf.approximate(POINTS, base, method, max_steps=steps, tol_average=1e-15, weights=few)
        total = float(jnp.sum(got.errors[:120] ** 2))
        assert total <= last * (1 + 1e-9)
        last = total
    assert int(got.stats["rejected_steps"]) > 0
    assert np.isfinite(np.asarray(got.surface.control_points)).all()


def test_damping_follows_the_fall_that_was_predicted(base):
    surface = WorkingSurface.of(base.control_points, base.knots_u, base.knots_v)
    cases = [  # damping, mean distance, objective, gain, accepted, next damping
        (0.1, 1.0, 1.5, 0.9, True, 0.025),
        (0.1, 1.0, 1.5, 0.4, True, 0.1),
        (0.1, 1.0, 1.5, 0.1, True, 0.4),
        (0.1, 1.0, 1.5, -1.0, False, 1.0),
        (1e-12, 1.0, 1.5, 1.0, True, LEAST_DAMPING),
        (0.5, 1.0, 1.5, -1.0, False, 1.0),
        (1e-4, 1.0, 20.0, 1.0, True, USUAL_DAMPING),  # a twentieth of the objective is no good part of it
        (1e-4, 0.2 * SMALL, 20.0, 1.0, True, 2.5e-5),  # only where distances are small
        (1e-4, 0.2 * SMALL, 20.0, 0.8, True, USUAL_DAMPING),  # and if it is what was predicted
        (1e-4, 0.2 * SMALL, 50.0, 1.0, True, USUAL_DAMPING),
    ]
    for mu, average, before, gain, good, after in cases:
        state = DampingState(surface, jnp.asarray(1.0), jnp.asarray(mu), jnp.asarray(0))
        got = next_damping(state, *(jnp.asarray(x) for x in (before, average, gain, good)))
        assert np.isclose(got, after, rtol=1e-6)


def test_steps_that_the_damping_alone_keeps_short_lower_it_where_the_border_is_free(base):
    surface = WorkingSurface.of(base.control_points, base.knots_u, base.knots_v)
    one, accepted = jnp.asarray(1.0), jnp.asarray(True)
    cases = [  # predicted, actual, whether the border is free, next damping
        (1.0, 1.98, True, 2.5e-5),
        (1.0, 1.9, True, USUAL_DAMPING),
        (1.0, 1.98, False, USUAL_DAMPING),
        (-1.0, 0.1, True, USUAL_DAMPING),
        (0.0, 0.0, True, USUAL_DAMPING),
    ]
    for predicted, gain, is_free, after in cases:
        state = DampingState(surface, jnp.asarray(predicted), jnp.asarray(1e-4), jnp.asarray(0))
        got = next_damping(state, 1e6 * one, one, jnp.asarray(gain), accepted, border_is_free=is_free)
        assert np.isclose(got, after, rtol=1e-6)


def test_rounding_does_not_decide_on_a_step_that_moves_nothing(base):
    surface = WorkingSurface.of(base.control_points, base.knots_u, base.knots_v)
    state = DampingState(surface, jnp.asarray(0.0), jnp.asarray(0.1), jnp.asarray(0))
    for after in (1.0, np.nextafter(1.0, 0.0), np.nextafter(1.0, 2.0)):
        gain = actual_gain(state, jnp.asarray(1.0), jnp.asarray(after))
        assert bool(is_no_worse(state, gain, jnp.asarray(0.0)))
        one = jnp.asarray(1.0)
        assert np.isclose(next_damping(state, one, one, gain, jnp.asarray(True)), 0.1)


@pytest.mark.slow
def test_small_fits_in_a_batch_differ_from_single_ones_by_rounding_alone():
    def height(x, y):
        return 0.1 * np.sin(3.0 * x + 0.5) * np.cos(2.5 * y)

    rng = np.random.default_rng(0)
    x, y = rng.uniform(size=(2, 32, 300))
    bump = rng.uniform(-0.1, 0.1, (32, 1)) * np.sin(np.pi * x) * np.sin(np.pi * y)
    clouds = jnp.asarray(np.stack([x, y, height(x, y) + bump], axis=-1))
    knots = clamped_uniform(8, 4)
    sites = np.asarray(jf.greville_abscissae(knots, 4))
    x, y = np.meshgrid(sites, sites, indexing="ij")
    sheet = jf.BSplineSurface(np.stack([x, y, height(x, y)], axis=-1), knots, knots)

    def net(points):
        return jf.approximate(points, sheet, tol_average=0.0, max_steps=20).surface.control_points

    single = jax.jit(net)
    apart = jax.jit(jax.vmap(net))(clouds) - jnp.stack([single(points) for points in clouds])
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)


def test_moves_reach_no_farther_than_a_share_of_the_spacing():
    net = jnp.asarray(np.random.default_rng(0).normal(size=(6, 5, 3)))
    move = jnp.zeros_like(net).at[2, 2].set(100.0).at[3, 3].set(1e-3)
    cut = np.asarray(within_reach(move, longest_moves(net, 0.6, net.shape[:2])))
    around = [np.linalg.norm(net[2, 2] - net[i, j]) for i, j in ((1, 2), (3, 2), (2, 1), (2, 3))]
    limit = 0.6 * min(np.mean(around[:2]), np.mean(around[2:]))
    assert np.isclose(np.linalg.norm(cut[2, 2]), limit)
    assert (cut[3, 3] == 1e-3).all()


@pytest.mark.slow
def test_a_spline_surface_is_found_again_without_its_parameters():
    got = data("bspline_reference")
    net, size = got["control_points"], diagonal(got["points"])
    knots = [got[x] / got[x][-1] for x in ("knots_u", "knots_v")]
    off = net.copy()
    off[1:-1, 1:-1] += 0.05 * size * np.random.default_rng(0).uniform(-1, 1, off[1:-1, 1:-1].shape)
    method = jf.OrthogonalDistance(smoothing=0.0)
    fit = jf.approximate(got["points"], jf.BSplineSurface(off, *knots), method, tol_average=2e-13)
    away = jf.closest_point(fit.surface, got["grid40"].reshape(-1, 3)).distance
    assert float(jnp.max(away)) < 1e-10 * size
    assert int(fit.stats["num_steps"]) < 40


@pytest.mark.float32_too
def test_a_tolerance_is_reached_in_few_steps(base):
    fit = jf.approximate(POINTS, base, jf.OrthogonalDistance(), tol_average=2e-4)
    assert bool(fit.converged), fit.message
    assert int(fit.stats["num_steps"]) <= 4
    distance = np.asarray(jf.closest_point(fit.surface, POINTS).distance) / fit.stats["diagonal"]
    assert np.abs(np.asarray(fit.errors) - distance).max() < 100 * eps() + 1e-9


@pytest.mark.slow
def test_new_knots_go_in_while_it_runs(base):
    insertion = jf.KnotInsertion(every=2, most=3)
    method = jf.OrthogonalDistance(smoothing=2e-12, insertion=insertion)
    fit = jf.approximate(POINTS, base, method, max_steps=7, tol_average=1e-9)
    assert fit.surface.shape == (11, 10)
    assert np.asarray(fit.history.net)[:, 0].tolist() == [8, 8, 8, 9, 9, 10, 10, 11]
    assert fit.history.average[-1] < 0.5 * fit.history.average[2]


@pytest.mark.slow
def test_fits_in_transformations(base, fit):
    feet = jf.closest_point(base, POINTS)
    start = (feet.u, feet.v)

    def net(points, smoothing):
        method = jf.OrthogonalDistance(smoothing=smoothing)
        fit = jf.approximate(points, base, method, max_steps=8, tol_average=1e-9, start=start)
        return fit.surface.control_points

    values = jnp.asarray([MEAN, 2e-6])
    both = jax.jit(jax.vmap(net, in_axes=(None, 0)))(jnp.asarray(POINTS), values)
    # Conjugate gradients stop early, where other sums have other rounding.
    assert np.abs(np.asarray(both[0]) - np.asarray(fit.surface.control_points)).max() < 1e-3
    assert np.abs(np.asarray(both[1] - both[0])).max() > 1e-4


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"smoothing": -1.0}, "smoothing must be a finite number"),
        ({"damping": 0.0}, "damping must be greater than 0"),
        ({"damping": 2.0}, "damping must be greater than 0"),
        ({"reach": 0.0}, "reach must be greater than 0"),
    ],
)
def test_impossible_fields_get_a_sentence(fields, sentence):
    with pytest.raises(ValueError, match=sentence):
        jf.OrthogonalDistance(**fields)
