"""Normals and curvatures equal those of surfaces whose geometry is known."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit._splines import BSplineSurface


def polynomial_surface(function, size=2.0):
    """The biquadratic Bezier patch (x, y, f(x, y)) over [0, size]^2, f at most biquadratic."""
    x = np.linspace(0, size, 3)
    xx, yy = np.meshgrid(x, x, indexing="ij")
    # Interpolation at three parameters per direction, solved for the control points.
    bernstein = np.array([[1, 0, 0], [0.25, 0.5, 0.25], [0, 0, 1]])
    inverse = np.linalg.inv(bernstein)
    net = np.stack([xx, yy, function(xx, yy)], axis=-1)
    net = np.einsum("ai,bj,ijd->abd", inverse, inverse, net)
    knots = np.array([0, 0, 0, size, size, size])
    return BSplineSurface(net, knots, knots)


X, Y = np.random.default_rng(0).uniform(0, 2, (2, 20))


@pytest.mark.float32_too
def test_curvatures_of_a_saddle_equal_their_formulas():
    x, y = X.astype(jnp.result_type(float)), Y.astype(jnp.result_type(float))
    surface = polynomial_surface(lambda x, y: x * y + 0.5 * x**2)
    fx, fy, fxx, fxy = y + x, x, 1.0, 1.0
    w = np.sqrt(1 + fx**2 + fy**2)
    gaussian = (0.0 * fxx - fxy**2) / w**4
    mean = ((1 + fy**2) * fxx - 2 * fx * fy * fxy) / (2 * w**3)
    result = surface.curvature(x, y)
    tolerance = {"rtol": 1e4 * helpers.eps(), "atol": 200 * helpers.eps()}
    np.testing.assert_allclose(result.gaussian, gaussian, **tolerance)
    np.testing.assert_allclose(result.mean, mean, **tolerance)
    np.testing.assert_allclose(result.k1 * result.k2, gaussian, **tolerance)
    np.testing.assert_allclose(result.k1 + result.k2, 2 * mean, **tolerance)
    assert (result.k1 >= result.k2).all()
    normal = np.stack([-fx, -fy, np.ones_like(x)], axis=-1) / w[:, None]
    np.testing.assert_allclose(surface.normal(x, y), normal, atol=50 * helpers.eps())


def test_fundamental_forms_equal_their_formulas():
    surface = polynomial_surface(lambda x, y: x * y)
    first, second = surface.first_form(X, Y), surface.second_form(X, Y)
    w = np.sqrt(1 + X**2 + Y**2)
    np.testing.assert_allclose(first.E, 1 + Y**2)
    np.testing.assert_allclose(first.F, X * Y)
    np.testing.assert_allclose(first.G, 1 + X**2)
    np.testing.assert_allclose(second.L, 0, atol=1e-13)
    np.testing.assert_allclose(second.M, 1 / w)
    np.testing.assert_allclose(second.N, 0, atol=1e-13)


def test_curvature_does_not_depend_on_position_and_parametrisation():
    surface = polynomial_surface(lambda x, y: x * y + 0.3 * y**2)
    rotation, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    moved = surface.affine(rotation, np.array([5e3, -2.0, 1.0]))
    squeezed = BSplineSurface(surface.control_points, surface.knots_u, surface.knots_v * 1e-3)
    there, here = surface.curvature(X, Y), moved.curvature(X, Y)
    for a, b, c in zip(there, here, squeezed.curvature(X, Y * 1e-3), strict=True):
        np.testing.assert_allclose(b, a, atol=1e-9)
        np.testing.assert_allclose(c, a, atol=1e-9)
    turned = surface.transpose().curvature(Y, X)
    np.testing.assert_allclose(turned.k1, -there.k2, atol=1e-12)


def test_any_scale_keeps_its_normals():
    # Squares of these tangents leave the range of the numbers.
    surface = polynomial_surface(lambda x, y: x * y + 0.3 * y**2)
    expected = surface.normal(X, Y)
    for scale in (1e-200, 1e200):
        scaled = surface.affine(scale * np.eye(3))
        np.testing.assert_allclose(scaled.normal(X, Y), expected, atol=1e-14)


def test_a_plane_is_flat_and_umbilics_have_finite_gradients():
    plane = polynomial_surface(lambda x, y: 0.5 * x - y)
    for value in plane.curvature(X, Y):
        np.testing.assert_allclose(value, 0, atol=1e-12)

    @jax.jit
    @jax.value_and_grad
    def principal(net):
        return BSplineSurface(net, plane.knots_u, plane.knots_v).curvature(0.0, 0.0).k1

    bowl = polynomial_surface(lambda x, y: 0.5 * (x**2 + y**2))
    for surface, expected in ((bowl, 1.0), (plane, 0.0)):
        value, slope = principal(surface.control_points)
        np.testing.assert_allclose(value, expected, atol=1e-12)
        assert np.isfinite(slope).all()


def test_a_pole_has_no_normal_and_finite_gradients():
    net = np.array(helpers.wavy_net(5, 4))
    net[0] = net[0, 0]
    knots = helpers.clamped_uniform(5, 4), helpers.clamped_uniform(4, 4)

    u, v = np.array([0.0, 0.5]), np.array([0.3, 0.3])

    def geometry(net):
        surface = BSplineSurface(net, *knots)
        values = surface.normal(u, v), surface.curvature(u, v), surface.second_form(u, v)
        return jnp.sum(values[0]) + jnp.nansum(values[1].mean), values

    slope, (normal, curvature, form) = jax.jit(jax.grad(geometry, has_aux=True))(net)
    assert np.isfinite(slope).all()
    assert not normal[0].any()
    np.testing.assert_allclose(np.linalg.norm(normal[1]), 1.0)
    for value in curvature:
        np.testing.assert_array_equal(np.isfinite(value), [False, True])
    assert not np.stack(form)[:, 0].any()


def test_parallel_tangents_have_no_normal():
    net = np.zeros((3, 3, 3))
    net[..., 0] = np.add.outer(np.arange(3.0), 0.3 * np.arange(3.0))
    net[..., 1] = 0.7 * net[..., 0]
    knots = np.array([0.0, 0, 0, 1, 1, 1])
    surface = BSplineSurface(net, knots, knots)
    assert not surface.normal(X / 2, Y / 2).any()


def test_only_three_dimensions_have_normals():
    flat = helpers.wavy_surface().affine(np.eye(2, 3))
    assert jax.eval_shape(flat.first_form, 0.5, 0.5).E.shape == ()
    for method in (flat.normal, flat.curvature, flat.second_form):
        with pytest.raises(ValueError, match=r"need a surface in three dimensions, .* has 2"):
            method(0.5, 0.5)
