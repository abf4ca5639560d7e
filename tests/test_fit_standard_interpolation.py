"""Standard interpolation: it is SciPy's two passes, differentiable, and honest where there is no solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations, diagonal, eps, wavy_grid
from scipy.interpolate import make_interp_spline

import jaxfit as jf

STANDARD = jf.StandardInterpolation()
GRID = wavy_grid(9, 8)
# Rows whose own parameters differ: each is stretched in its own way.
X, Y = GRID[..., 0], GRID[..., 1]
SHEARED = GRID + 0.1 * np.stack([X * Y**2, Y * X**2, 0 * X], axis=-1)


def net_of(grid, order=(4, 4), method=STANDARD):
    return jf.interpolate(grid, method, order).surface.control_points


def two_passes(fit, grid):
    """SciPy's nets at the same parameters and knots."""
    (K, L), surface = fit.surface.order, fit.surface
    u, v = np.asarray(fit.u[:, 0]), np.asarray(fit.v[0])
    half = make_interp_spline(u, grid, K - 1, t=np.asarray(surface.knots_u)).c
    return make_interp_spline(v, half, L - 1, t=np.asarray(surface.knots_v), axis=1).c.swapaxes(0, 1)


def random_grid(n, m, d, seed=0):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    parts = [x, y, np.sin(x) + np.cos(y), x * y / n, x - y][:d] if d > 1 else [x + y]
    return np.stack(parts, axis=-1) + 0.2 * rng.random((n, m, d))


def test_one_order_is_that_of_both_directions():
    grid = GRID[:5, :6]
    np.testing.assert_array_equal(net_of(grid, 3), net_of(grid, (3, 3)))


@pytest.mark.parametrize(
    ("n", "m", "d", "order"),
    [
        (2, 2, 3, (2, 2)),
        (4, 4, 1, (4, 4)),
        (3, 20, 2, (3, 4)),
        (9, 11, 5, (3, 5)),
        (9, 11, 3, (6, 8)),
        (7, 5, 3, (2, 2)),
    ],
)
def test_it_is_two_passes_of_curve_interpolation(n, m, d, order):
    grid = random_grid(n, m, d)
    fit = jf.interpolate(grid, STANDARD, order)
    assert bool(fit.converged), fit.message
    expected = two_passes(fit, grid)
    assert np.abs(np.asarray(fit.surface.control_points) - expected).max() < 1e-12 * np.abs(expected).max()
    assert fit.surface.order == order
    assert int(fit.stats["num_steps"]) == 0


@pytest.mark.float32_too
def test_the_surface_passes_through_every_grid_point():
    fit = jf.interpolate(GRID, STANDARD)
    assert bool(fit.converged), fit.message
    there = np.asarray(fit.surface(fit.u, fit.v))
    assert np.abs(there - GRID).max() <= 50 * eps()
    assert float(fit.maximum_error) <= 20 * eps()
    assert fit.u.shape == fit.v.shape == fit.errors.shape == GRID.shape[:2]
    assert fit.surface.control_points.dtype == jnp.result_type(float)


def test_a_closed_grid_gives_a_closed_surface():
    angle, x = np.linspace(0, 2 * np.pi, 13)[:, None], np.linspace(0, 3, 8)[None, :]
    grid = np.stack(np.broadcast_arrays(x, np.cos(angle) * (1 + 0.1 * x), np.sin(angle)), axis=-1)
    grid[-1] = grid[0]
    net = np.asarray(net_of(grid))
    assert np.abs(net[0] - net[-1]).max() < 1e-14


@pytest.mark.parametrize("order", [(4, 4), (3, 5)])
def test_derivatives_are_those_of_finite_differences(order):
    grid = jnp.asarray(random_grid(7, 9, 3))
    direction, cotangent = (random_grid(7, 9, 3, seed) - 4 for seed in (1, 2))

    def value(grid):
        fit = jf.interpolate(grid, STANDARD, order)
        return jnp.sum(cotangent * fit.surface.control_points) + fit.average_error

    step = 1e-5
    sides = [np.sum(cotangent * np.asarray(net_of(grid + s * direction, order))) for s in (step, -step)]
    expected = (sides[0] - sides[1]) / (2 * step)
    gradient = np.asarray(jax.jit(jax.grad(value))(grid))
    assert np.isfinite(gradient).all()
    assert abs(np.sum(gradient * direction) - expected) < 1e-6 * abs(expected)


@pytest.mark.float32_too
def test_vmap_and_jit_give_the_same_as_plain_calls():
    grids = np.stack([random_grid(6, 5, 3, seed) for seed in range(32)])
    together = np.asarray(jax.jit(jax.vmap(net_of))(jnp.asarray(grids)))
    for grid, net in zip(grids, together, strict=True):
        assert np.abs(np.asarray(net_of(grid)) - net).max() < 200 * eps() * np.abs(net).max()


def hostile(case):
    grid = random_grid(12, 10, 3)
    if case == "repeated row":
        grid[5] = grid[4]
    elif case == "collinear":
        grid = grid[..., :1] * np.array([1.0, 2.0, 3.0])
    elif case == "uneven":
        x = np.cumsum(np.r_[0, np.tile([1.0, 1e-3], 6)])[:12]
        grid[..., 0] = x[:, None]
    elif case == "far away":
        grid = grid + np.array([5e6, 4e6, -5e6])
    return grid


@pytest.mark.float32_too
@pytest.mark.parametrize("case", ["repeated row", "collinear", "uneven", "far away"])
def test_hostile_grids_are_met_at_rounding_level(case):
    grid = hostile(case)
    fit = jf.interpolate(grid, STANDARD)
    assert np.isfinite(np.asarray(fit.surface.control_points)).all()
    net = np.asarray(fit.surface.control_points)
    size = np.abs(net - grid.mean((0, 1))).max() / diagonal(grid)
    rounding = np.abs(net).max() / diagonal(grid)  # of the net, far from the origin
    assert float(fit.maximum_error) <= eps() * (100 * max(size, 1) + rounding)
    if case == "far away":
        assert float(fit.maximum_error) >= 0.1 * eps() * rounding


def constant_along_first():
    return np.repeat(GRID[:1], 6, axis=0)


@pytest.mark.parametrize(
    ("grid", "sentence"),
    [
        (np.where(GRID[3, 3] == GRID, np.nan, GRID), "grid must be finite"),
        (GRID[:3], "grid must have at least 4 x 4 points"),
        (np.ones((5, 5, 3)), "must not all coincide"),
        (constant_along_first(), "must extend along its first index"),
    ],
)
def test_bad_grids_get_a_sentence(grid, sentence):
    with pytest.raises(ValueError, match=sentence):
        jf.interpolate(grid, STANDARD)


def test_a_second_grid_of_the_same_shape_compiles_nothing():
    jf.interpolate(GRID, STANDARD)
    with count_compilations() as compiled:
        jf.interpolate(2 * GRID[::-1], STANDARD)
    assert compiled.count == 0


PER_POINT = jf.StandardInterpolation(per_point=True)


def test_every_point_can_keep_its_own_parameters():
    fit = jf.interpolate(SHEARED, PER_POINT)
    own = jf.grid_parameters(SHEARED)
    assert np.ptp(np.asarray(own.rows_u), axis=1).max() > 1e-3
    assert bool(fit.converged), fit.message
    assert np.abs(np.asarray(fit.u) - own.rows_u).max() < 1e-15
    assert np.abs(np.asarray(fit.surface(fit.u, fit.v)) - SHEARED).max() < 1e-12
    assert len(fit.history.maximum) == int(fit.stats["num_steps"]) + 1
    assert float(fit.maximum_error) == float(fit.errors.max())
    assert abs(float(fit.history.maximum[-1]) - float(fit.maximum_error)) <= 2 * eps()


@pytest.mark.slow
def test_derivatives_with_a_parameter_pair_for_every_point():
    direction, cotangent = (random_grid(9, 8, 3, seed) / 20 for seed in (1, 2))

    def net(grid):
        return net_of(grid, method=PER_POINT)

    step = 1e-4
    sides = [np.sum(cotangent * np.asarray(net(SHEARED + s * direction))) for s in (step, -step)]
    expected = (sides[0] - sides[1]) / (2 * step)
    gradient = jax.jit(jax.grad(lambda grid: jnp.sum(cotangent * net(grid))))(jnp.asarray(SHEARED))
    assert abs(np.sum(np.asarray(gradient) * direction) - expected) < 1e-6 * abs(expected)


def test_a_system_without_a_solution_is_reported_and_nothing_is_nan():
    grid = GRID.copy()
    grid[:, ::2, 0] **= 3  # every other row of points far from the average
    fit = jf.interpolate(grid, PER_POINT)
    assert not bool(fit.converged)
    assert np.isfinite(np.asarray(fit.surface.control_points)).all()
    assert float(fit.history.maximum[-1]) < float(fit.history.maximum[0])
    with pytest.raises(RuntimeError, match="stopped falling"):
        jf.interpolate(grid, PER_POINT, throw=True)


def test_points_on_the_surface_need_no_correction():
    method = jf.StandardInterpolation(parameter_correction=True)
    fit = jf.interpolate(GRID, method)
    assert bool(fit.converged), fit.message
    assert int(fit.stats["corrections"]) == 1
    assert float(fit.stats["parameter_change"]) < 1e-12
    assert np.abs(np.asarray(fit.surface.control_points) - net_of(GRID)).max() < 1e-13
