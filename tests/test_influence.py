"""What has no influence on a fit has none at all, and what a fit cannot give is refused, never zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_except, wavy_cloud

import jaxfit as jf

POINTS, EDGES = wavy_cloud(200)
METHODS = {
    "geometric": jf.GeometricApproximation(),
    "paper": jf.GeometricApproximation.paper(insertion=None),
    "standard": jf.StandardApproximation(smoothing=1e-6),
    "robust": jf.StandardApproximation(smoothing=1e-6, loss=jf.Huber()),
    "orthogonal": jf.OrthogonalDistance(smoothing=1e-6),
    "default": jf.OrthogonalDistance(),
}
MAGNIFIES = ("orthogonal", "default")  # rounding, by conjugate gradients that end before they converge
OPTIONS = dict(tol_average=1e-9, max_steps=12)


@pytest.fixture(scope="module")
def base():
    return jf.base_surface(jf.Boundary(**EDGES), net=(7, 6))


@pytest.mark.parametrize("name", slow_except(METHODS, "geometric", "standard"))
def test_points_of_weight_zero_have_no_influence(base, name):
    # 224 points are padded as 200 are, and share their program; 300 are not.
    count = 100 if name in ("geometric", "default") else 24
    away = np.random.default_rng(0).uniform(-2, 3, (count, 3))
    cloud, weights = np.concatenate([POINTS, away]), np.repeat([1.0, 0.0], [200, count])
    alone = jf.approximate(POINTS, base, METHODS[name], **OPTIONS)
    padded = jf.approximate(cloud, base, METHODS[name], weights=weights, **OPTIONS)
    difference = np.asarray(alone.surface.control_points - padded.surface.control_points)
    assert np.abs(difference).max() < (1e-7 if name in MAGNIFIES else 1e-10)
    rtol = 1e-6 if name in MAGNIFIES else 1e-7
    np.testing.assert_allclose(alone.history.average, padded.history.average, rtol=rtol)
    assert np.isclose(alone.average_error, padded.average_error, rtol=rtol)
    assert float(padded.errors[200:].min()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["geometric", "orthogonal", "default"])
def test_a_batch_of_fits_is_the_fits_one_by_one(base, name):
    clouds = jnp.stack([POINTS, POINTS + 0.01, POINTS * 1.02])

    def net(points):
        return jf.approximate(points, base, METHODS[name], **OPTIONS).surface.control_points

    batch = jax.jit(jax.vmap(net))(clouds)
    for one, cloud in zip(batch, clouds, strict=True):
        apart = np.abs(np.asarray(one - net(np.asarray(cloud)))).max()
        assert apart < (1e-7 if name in MAGNIFIES else 1e-12)


def test_other_values_of_numbers_compile_nothing(base):
    from helpers import count_compilations

    def fit(smoothing, damping, scale):
        method = jf.OrthogonalDistance(smoothing=smoothing, damping=damping, loss=jf.Huber(scale))
        return jf.approximate(POINTS, base, method, **OPTIONS)

    fit(1e-6, 0.01, 1e-2)
    with count_compilations() as compiled:
        fit(3e-6, 0.02, 2e-2)
    assert compiled.count == 0


@pytest.mark.parametrize(
    ("border", "free"),
    [
        (jf.FixedBorder(), 0),
        (jf.FixedCorners(), 18),
        (jf.FreeBorder(), 22),
        (jf.FixedSides(u0=True, v1=True), 10),
    ],
    ids=lambda x: type(x).__name__ if not isinstance(x, int) else "",
)
def test_the_border_that_is_free_moves_and_no_other(base, border, free):
    method = jf.StandardApproximation(smoothing=1e-5, border=border)
    fit = jf.approximate(POINTS, base, method, tol_average=1e-9, max_steps=2)
    moved = np.any(np.asarray(fit.surface.control_points) != np.asarray(base.control_points), axis=-1)
    edge = np.ones((7, 6), bool)
    edge[1:-1, 1:-1] = False
    assert moved[1:-1, 1:-1].all()
    assert moved[edge].sum() == free


@pytest.mark.parametrize("errors", [jf.AtParameters(), jf.LocalFeet(), jf.GlobalFeet()])
def test_errors_are_measured_as_certainly_as_asked_for(base, errors):
    start = tuple(np.random.default_rng(1).uniform(0, 1, (2, 200)))
    method = jf.StandardApproximation(parameter_correction=False, smoothing=1e-3)
    fit = jf.approximate(POINTS, base, method, start=start, max_steps=1, errors=errors)
    nearest = jf.closest_point(fit.surface, POINTS).distance / fit.stats["diagonal"]
    at = np.linalg.norm(np.asarray(fit.surface(fit.u, fit.v)) - POINTS, axis=1) / fit.stats["diagonal"]
    np.testing.assert_allclose(fit.errors, at, atol=1e-12)
    assert (np.asarray(fit.errors) >= np.asarray(nearest) - 1e-12).all()
    if isinstance(errors, jf.AtParameters):
        np.testing.assert_array_equal(fit.u, start[0])
        assert float(fit.average_error) > 1.1 * float(nearest.mean())
    if isinstance(errors, jf.GlobalFeet):
        np.testing.assert_allclose(fit.errors, nearest, atol=1e-12)


def test_a_limit_on_the_iterations_that_is_out_of_reach_costs_no_memory(base):
    fit = jf.approximate(POINTS, base, METHODS["geometric"], tol_average=1e-3, max_steps=10**9)
    assert bool(fit.converged)
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0), [0.0], indexing="ij"), -1)[:, :, 0]
    assert bool(jf.interpolate(grid, max_steps=10**9).converged)
