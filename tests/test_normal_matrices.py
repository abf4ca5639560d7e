"""Normal matrices and thin plates equal dense ones, for any orders, repeated knots and blocks of rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import clamped_uniform, eps, random_clamped_knots
from normal_reference import design, thin_plate_matrix

import jaxfit as jf
from jaxfit._normal_equations import _normal_matrix, curvature_energy, make_system, thin_plate
from jaxfit._splines._pieces import make_axis, make_pieces


def surface_of(order, extra=(4, 3), seed=0, repeats=0):
    rng = np.random.default_rng(seed)
    shape = tuple(k + n for k, n in zip(order, extra, strict=True))
    knots = [random_clamped_knots(rng, n, k, repeats) for n, k in zip(shape, order, strict=True)]
    return jf.BSplineSurface(rng.normal(size=(*shape, 3)), *knots)


def system_of(surface, count=300, seed=1):
    rng = np.random.default_rng(seed)
    dtype = jnp.result_type(float)
    u, v, weight = (x.astype(dtype) for x in rng.random((3, count)))
    weight[::7] = 0.0
    target, smoothing = rng.normal(size=(3, count)).astype(dtype), np.asarray(1e-3, dtype)
    pieces = make_pieces(*(np.asarray(x) for x in jax.tree.leaves(surface)))
    system = jax.jit(make_system)(pieces, u, v, target, weight, smoothing)
    return system, design(surface, u, v), weight


@pytest.mark.float32_too
@pytest.mark.parametrize(("order", "repeats"), [((4, 4), 2), ((3, 2), 0)])
def test_the_stencil_is_the_normal_matrix(order, repeats):
    surface = surface_of(order, repeats=repeats)
    system, a, weight = system_of(surface)
    expected = a.T @ (weight[:, None] * a)
    stencil = jax.jit(lambda system: system.data_stencil())(system)
    assert np.abs(np.asarray(stencil.dense()) - expected).max() < 30 * eps() * expected.max()
    assert (
        np.abs(np.asarray(stencil.diagonal).ravel() - np.diag(expected)).max() < 30 * eps() * expected.max()
    )


def test_blocks_of_rows_add_up_to_the_same(monkeypatch):
    system, _, _ = system_of(surface_of((4, 4), repeats=2))
    whole = jax.jit(lambda system: system.data_stencil())(system)
    monkeypatch.setattr(_normal_matrix, "SLOTS_AT_ONCE", 8 * 40)
    blocks = jax.jit(lambda system: system.data_stencil())(system)
    assert np.abs(np.asarray(whole.entries - blocks.entries)).max() < 1e-13


@pytest.mark.parametrize(("order", "repeats"), [((4, 4), 2), ((5, 3), 0), ((2, 4), 0)])
def test_the_thin_plate_is_that_of_an_independent_quadrature(order, repeats):
    surface = surface_of(order, repeats=repeats)
    knots = zip((surface.knots_u, surface.knots_v), order, strict=True)
    axes = [make_axis(np.asarray(x), k) for x, k in knots]

    @jax.jit
    def parts(axes, net):
        plate = thin_plate(*axes)
        residual = plate.residual(net)
        return plate.stencil().dense(), jnp.sum(residual**2), plate.adjoint(residual)

    matrix, energy, gradient = parts(axes, surface.control_points)
    expected = thin_plate_matrix(surface)
    assert np.abs(np.asarray(matrix) - expected).max() < 1e-12 * np.abs(expected).max()
    net = np.asarray(surface.control_points).reshape(-1, 3)
    product = expected @ net
    assert abs(float(energy) - np.sum(net * product)) < 1e-12 * float(energy)
    assert np.abs(np.asarray(gradient).reshape(-1, 3) - product).max() < 1e-12 * np.abs(product).max()


def test_the_domain_counts_as_the_unit_square():
    surface = surface_of((4, 4))
    scaled = (make_axis(3.0 * np.asarray(x) - 1.0, 4) for x in (surface.knots_u, surface.knots_v))
    expected = thin_plate_matrix(surface)
    matrix = np.asarray(jax.jit(lambda *axes: thin_plate(*axes).stencil().dense())(*scaled))
    assert np.abs(matrix - expected).max() < 1e-12 * np.abs(expected).max()


def test_the_adjoint_is_the_transposed_jacobian():
    surface = surface_of((4, 4), repeats=2)
    system, a, weight = system_of(surface)
    net = surface.control_points
    target = np.zeros((300, 3))
    rows = np.asarray(system.rows.point)
    taken = rows < 300
    target[rows[taken]] = np.moveaxis(np.asarray(system.target), 0, -1)[taken]
    flat = np.asarray(net).reshape(-1, 3)
    expected = a.T @ (weight[:, None] * (a @ flat - target)) + 1e-3 * thin_plate_matrix(surface) @ flat
    gradient = jax.jit(lambda system, net: system.adjoint(system.residual(net)))(system, net)
    assert np.abs(np.asarray(gradient).reshape(-1, 3) - expected).max() < 1e-11 * np.abs(expected).max()


def test_curvature_energy_of_a_paraboloid():
    knots = clamped_uniform(4, 4)
    greville = np.linspace(0, 1, 4)
    x, y = np.meshgrid(greville, greville, indexing="ij")
    square = np.array([0.0, 0.0, 1.0, 3.0]) / 3.0  # Bezier coefficients of t^2
    z = 0.5 * (square[:, None] + square[None, :])
    surface = jf.BSplineSurface(np.stack([x, y, z], axis=-1), knots, knots)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    u, v = np.meshgrid(0.5 * nodes + 0.5, 0.5 * nodes + 0.5, indexing="ij")
    w = 1 + u**2 + v**2
    mean2, gauss = (2 + u**2 + v**2) ** 2 / w**3, 1 / w**2  # (2 H)^2 and K of z = (x^2 + y^2) / 2
    expected = 0.25 * np.einsum("i,j,ij", weights, weights, (mean2 - 2 * gauss) * np.sqrt(w))
    assert abs(float(curvature_energy(surface, points=12)) - expected) < 1e-9
    scaled = surface.affine(5.0 * np.eye(3), np.ones(3))
    assert abs(float(curvature_energy(scaled, points=12)) - expected) < 1e-9


def test_curvature_energy_of_a_plane_surface_gets_a_sentence():
    surface = jf.BSplineSurface(np.zeros((4, 4, 2)), clamped_uniform(4, 4), clamped_uniform(4, 4))
    with pytest.raises(ValueError, match="surface must have 3 coordinates"):
        curvature_energy(surface)
