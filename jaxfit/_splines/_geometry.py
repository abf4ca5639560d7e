"""Differential geometry of a surface from its partial derivatives at a point."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfit._compile import compiled

Partials = dict[tuple[int, int], Array]


class FirstForm(NamedTuple):
    r"""First fundamental form $E\,du^2 + 2 F\,du\,dv + G\,dv^2$: lengths on a surface.

    The unit is length^2. From `BSplineSurface.first_form`, in any dimension.

    Attributes
    ----------
    E, F, G : array, of the shape of the parameters
        $R_u \cdot R_u$, $R_u \cdot R_v$, $R_v \cdot R_v$.

    Notes
    -----
    Source: M. P. do Carmo, Differential Geometry of Curves and Surfaces, section 2.5.

    Examples
    --------
    >>> net = np.array([[[0.0, 0, 0], [1, 3, 0]], [[2, 0, 0], [3, 3, 0]]])
    >>> knots = np.array([0.0, 0, 1, 1])
    >>> form = jf.BSplineSurface(net, knots, knots).first_form(0.5, 0.5)
    >>> float(form.E), float(form.F), float(form.G)
    (4.0, 2.0, 10.0)
    """

    E: Float[Array, "*shape"]
    F: Float[Array, "*shape"]
    G: Float[Array, "*shape"]


class SecondForm(NamedTuple):
    r"""Second fundamental form $L\,du^2 + 2 M\,du\,dv + N\,dv^2$: distances from the tangent plane.

    The unit is length. From `BSplineSurface.second_form`, in three dimensions.

    Attributes
    ----------
    L, M, N : array, of the shape of the parameters
        $R_{uu} \cdot n$, $R_{uv} \cdot n$, $R_{vv} \cdot n$ with the unit normal n.

    Notes
    -----
    Source: M. P. do Carmo, Differential Geometry of Curves and Surfaces, section 3.3.

    Examples
    --------
    >>> net = np.array([[[0.0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 1]]])
    >>> knots = np.array([0.0, 0, 1, 1])
    >>> form = jf.BSplineSurface(net, knots, knots).second_form(0.0, 0.0)
    >>> float(form.L), float(form.M), float(form.N)
    (0.0, 1.0, 0.0)
    """

    L: Float[Array, "*shape"]
    M: Float[Array, "*shape"]
    N: Float[Array, "*shape"]


class Curvature(NamedTuple):
    r"""Curvatures of a surface, in 1/length.

    Attributes
    ----------
    gaussian : array, of the shape of the parameters
        $k_1 k_2 = (L N - M^2) / (E G - F^2)$, in 1/length^2.
    mean : array, of the shape of the parameters
        $(k_1 + k_2) / 2 = (E N - 2 F M + G L) / (2 (E G - F^2))$.
    k1, k2 : array, of the shape of the parameters
        Principal curvatures, $k_1 \ge k_2$; positive where the surface bends towards the normal
        $R_u \times R_v$. At umbilics ($k_1 = k_2$) they have no derivative, and automatic
        differentiation gives that of the mean curvature.

    Notes
    -----
    Source: M. P. do Carmo, Differential Geometry of Curves and Surfaces, section 3.3.

    Examples
    --------
    The saddle z = u v at its centre:

    >>> net = np.array([[[0.0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 1]]])
    >>> knots = np.array([0.0, 0, 1, 1])
    >>> at_centre = jf.BSplineSurface(net, knots, knots).curvature(0.0, 0.0)
    >>> [round(float(x), 6) + 0.0 for x in (at_centre.gaussian, at_centre.mean, at_centre.k1, at_centre.k2)]
    [-1.0, 0.0, 1.0, -1.0]
    """

    gaussian: Float[Array, "*shape"]
    mean: Float[Array, "*shape"]
    k1: Float[Array, "*shape"]
    k2: Float[Array, "*shape"]


@compiled
def unit_normal(ru: Float[Array, "*shape 3"], rv: Float[Array, "*shape 3"]) -> Float[Array, "*shape 3"]:
    """Unit normal of two tangents, zero where they span no plane."""
    a, b = _unit(ru, 0.0), _unit(rv, 0.0)
    # Of unit tangents the cross product has the length of a sine; below a few rounding units
    # its direction is noise.
    return _unit(jnp.cross(a, b), 8 * float(jnp.finfo(ru.dtype).eps))


@compiled
def first_form(ru: Float[Array, "*shape d"], rv: Float[Array, "*shape d"]) -> FirstForm:
    """E, F, G of two tangents."""
    return FirstForm(_dot(ru, ru), _dot(ru, rv), _dot(rv, rv))


@compiled
def second_form(partials: Partials) -> SecondForm:
    """L, M, N of the partial derivatives up to order two."""
    normal = unit_normal(partials[1, 0], partials[0, 1])
    return SecondForm(*(_dot(partials[key], normal) for key in ((2, 0), (1, 1), (0, 2))))


@compiled
def curvature(partials: Partials) -> Curvature:
    """Curvatures from the partial derivatives up to order two."""
    ru, rv = partials[1, 0], partials[0, 1]
    normal = unit_normal(ru, rv)
    regular = jnp.any(normal != 0, axis=-1)
    along = _guarded(regular, _length(ru))
    # Gram-Schmidt turns the tangents into an orthonormal frame, in which the shape operator is
    # the symmetric matrix [[a, b], [b, c]]. The difference of its eigenvalues is then a
    # hypotenuse: the textbook H^2 - K cancels, and may even come out negative.
    first = ru / along[..., None]
    shear = _dot(rv, first)
    across = _guarded(regular, _length(rv - shear[..., None] * first))
    L, M, N = (_dot(partials[key], normal) for key in ((2, 0), (1, 1), (0, 2)))
    slope = shear / along
    a = L / along**2
    b = (M - slope * L) / (along * across)
    c = (N - 2 * slope * M + slope**2 * L) / across**2
    mean = (a + c) / 2
    radius = _length(jnp.stack([(a - c) / 2, b], axis=-1))
    values = (a * c - b**2, mean, mean + radius, mean - radius)
    return Curvature(*(jnp.where(regular, value, jnp.nan) for value in values))


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _length(a: Array) -> Array:
    """Euclidean length, scaled against under- and overflow, with gradient zero at zero."""
    scale = jnp.max(jnp.abs(jax.lax.stop_gradient(a)), axis=-1)
    scale = _guarded((scale > 0) & jnp.isfinite(scale), scale)
    squared = jnp.sum((a / scale[..., None]) ** 2, axis=-1)
    positive = squared > 0
    return jnp.where(positive, scale * jnp.sqrt(_guarded(positive, squared)), squared)


def _unit(a: Array, least: float) -> Array:
    """`a` over its length where that exceeds `least`, else zero."""
    length = _length(a)
    enough = length > least
    return jnp.where(enough[..., None], a / _guarded(enough, length)[..., None], 0.0)


def _guarded(valid: Array, denominator: Array) -> Array:
    """The denominator where valid, else one: keeps the unused branch of a `where` finite."""
    return jnp.where(valid, denominator, 1.0)
