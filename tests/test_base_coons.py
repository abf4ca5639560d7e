"""The Coons blend is equations (6)-(7), keeps its four sides and reproduces bilinear patches."""

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfit._base import Greville, Uniform, coons_surface
from jaxfit._splines import BSplineCurve, greville_abscissae

NU, NV, ORDER = 7, 6, (4, 3)


def knots(uneven=True):
    rng = np.random.default_rng(3)
    if not uneven:
        return tuple(helpers.clamped_uniform(n, k) for n, k in zip((NU, NV), ORDER, strict=True))
    return tuple(helpers.random_clamped_knots(rng, n, k) for n, k in zip((NU, NV), ORDER, strict=True))


def sides(net, knots_u, knots_v):
    along_u = [BSplineCurve(net[:, j], knots_u) for j in (0, -1)]
    return (*along_u, *(BSplineCurve(net[i], knots_v) for i in (0, -1)))


def naive(net, s, t):
    """Equation (7), control point by control point."""
    result = np.zeros_like(net)
    for i in range(len(s)):
        for j in range(len(t)):
            a, b = s[i], t[j]
            result[i, j] = (1 - a) * net[0, j] + a * net[-1, j]
            result[i, j] += (1 - b) * net[i, 0] + b * net[i, -1]
            result[i, j] -= (1 - a) * ((1 - b) * net[0, 0] + b * net[0, -1])
            result[i, j] -= a * ((1 - b) * net[-1, 0] + b * net[-1, -1])
    return result


@pytest.mark.float32_too
@pytest.mark.parametrize("abscissae", [Greville(), Uniform()], ids=["greville", "uniform"])
def test_the_net_is_equation_seven(abscissae):
    net = np.random.default_rng(0).normal(size=(NU, NV, 3))
    knots_u, knots_v = knots()
    surface = coons_surface(*sides(net, knots_u, knots_v), abscissae)
    s, t = np.linspace(0, 1, NU), np.linspace(0, 1, NV)
    if isinstance(abscissae, Greville):
        s, t = (np.asarray(greville_abscissae(k, o)) for k, o in zip(knots(), ORDER, strict=True))
    np.testing.assert_allclose(surface.control_points, naive(net, s, t), atol=20 * helpers.eps())
    np.testing.assert_array_equal(surface.control_points[:, 0], jnp.asarray(net[:, 0]))


@pytest.mark.float32_too
def test_greville_reproduces_the_bilinear_patch_on_any_knots_and_uniform_does_not():
    corners = np.random.default_rng(1).normal(size=(2, 2, 3))

    def bilinear(s, t):
        a, b = np.stack([1 - s, s], -1), np.stack([1 - t, t], -1)
        return np.einsum("ia,jb,abd->ijd", a, b, corners)

    s, t = (np.asarray(greville_abscissae(k, o)) for k, o in zip(knots(), ORDER, strict=True))
    us, vs = np.linspace(0, 1, 9), np.linspace(0, 1, 8)
    exact = coons_surface(*sides(bilinear(s, t), *knots())).grid(us, vs)
    np.testing.assert_allclose(exact, bilinear(us, vs), atol=20 * helpers.eps())
    skew = coons_surface(*sides(bilinear(s, t), *knots()), Uniform()).grid(us, vs)
    assert np.abs(skew - bilinear(us, vs)).max() > 1e-3


def test_different_knots_are_refused():
    net = helpers.wavy_net(NU, NV)
    knots_u, knots_v = knots()
    v0, v1, u0, u1 = sides(net, knots_u, knots_v)
    with pytest.raises(ValueError, match="v0 and v1 must have the same knots"):
        coons_surface(v0, BSplineCurve(v1.control_points, knots(uneven=False)[0]), u0, u1)
    with pytest.raises(ValueError, match="u0 and u1 must have the same knots"):
        coons_surface(v0, v1, u0.insert_knots([0.5]), u1)


def test_curves_that_cannot_be_sides_are_refused():
    v0, v1, u0, u1 = sides(helpers.wavy_net(NU, NV), *knots())
    with pytest.raises(TypeError, match="v0 must be an object such as BSplineCurve"):
        coons_surface(np.asarray(v0.control_points), v1, u0, u1)
    with pytest.raises(TypeError, match="abscissae must be an object such as Greville"):
        coons_surface(v0, v1, u0, u1, "greville")
    flat = BSplineCurve(u1.control_points[:, :2], u1.knots)
    with pytest.raises(ValueError, match="u1 lies in 2 dimensions and v0 in 3"):
        coons_surface(v0, v1, u0, flat)
    off = BSplineCurve(u0.control_points + 5.0, u0.knots)
    with pytest.raises(ValueError, match=r"v\d and u0 must share a corner, but their ends are 8\.66 apart"):
        coons_surface(v0, v1, off, u1)


def test_derivatives_with_respect_to_points_and_knots_equal_differences():
    @jax.jit  # traced knots may be moved off their clamped ends
    def value(net, knots_u, knots_v):
        return jnp.sum(jnp.sin(3.0 * coons_surface(*sides(net, knots_u, knots_v)).control_points))

    check_grads(value, (helpers.wavy_net(NU, NV), *knots()), order=1, modes=["rev"])
