"""How fair a surface looks: zebra stripes as arrays, no drawing."""

from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfit._checks import as_direction, check_number
from jaxfit._compile import compiled
from jaxfit._splines import BSplineSurface
from jaxfit._splines._geometry import unit_normal

Vector = ArrayLike | Sequence[float | int]

_Z = (0.0, 0.0, 1.0)
_Y = (0.0, 1.0, 0.0)


def zebra(
    surface: BSplineSurface,
    u: ArrayLike,
    v: ArrayLike,
    direction: Vector = _Y,
    stripes: int = 16,
    view: Vector = _Z,
) -> Float[Array, "*shape"]:
    r"""Zebra stripes: what a striped room looks like in a polished surface, as values from 0 to 1.

    A far eye looks at the surface from the direction $\mathbf e$. With the unit normal $\mathbf n$ of the
    surface the ray it sees leaves along

    $$\mathbf r = 2 (\mathbf n \cdot \mathbf e)\, \mathbf n - \mathbf e ,$$

    whichever side $\mathbf n$ is on. The lights are far away as well, rings round the axis $\mathbf a$, and
    the value is a wave in the angle $\theta$ between the ray and that axis,

    $$z = \tfrac12 \bigl(1 + \cos(2 N \theta)\bigr), \qquad \theta = \arccos(\mathbf r \cdot \mathbf a),$$

    which is the same for $\mathbf a$ and $-\mathbf a$. Lines of constant $z$ are reflection lines. They
    depend on first derivatives, so they break where the normal jumps, kink where the curvature
    jumps, and wiggle where it oscillates. A plane has one value throughout; so does a line along which
    the surface does not turn.

    Parameters
    ----------
    surface : BSplineSurface
        In three dimensions.
    u, v : arrays of any shape
        Parameters; the two broadcast against each other.
    direction : array (3,)
        The axis $\mathbf a$ of the lights, of any length (default y). Stripes run roughly across it.
    stripes : int
        The number $N$ of bright stripes in half a turn of the ray from $\mathbf a$ to $-\mathbf a$ (default
        16).
    view : array (3,)
        The direction $\mathbf e$ from the surface to the eye, of any length (default z).

    Returns
    -------
    array
        1 in the middle of a bright stripe, 0 in the middle of a dark one; NaN where the surface has no
        normal. A threshold at 0.5 makes sharp stripes.

    Raises
    ------
    ValueError
        If the surface is not in three dimensions, a direction is zero, or `stripes` is not a whole number
        of at least 1.

    Notes
    -----
    The picture of Figs. 1 and 10 of Kineri, Wang, Lin and Maekawa (2012). On a symmetric surface the
    stripes are symmetric if `view` lies in its plane, and `direction` in it or across it. Works under `jit`
    and `vmap`; the derivative is zero where the ray meets the axis.

    Examples
    --------
    >>> x, y = np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij")
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> square = jf.BSplineSurface(np.stack([x, y, 0 * x], axis=2), knots, knots)
    >>> round(float(jf.zebra(square, 0.5, 0.5)), 3)
    1.0
    """
    axis, eye = _checked(direction, stripes, view)
    return _wave(surface.normal(u, v), axis, eye, int(stripes))


def zebra_grid(
    surface: BSplineSurface,
    us: ArrayLike,
    vs: ArrayLike,
    direction: Vector = _Y,
    stripes: int = 16,
    view: Vector = _Z,
) -> Float[Array, "a b"]:
    """`zebra` at all combinations of `us` (a,) and `vs` (b,), much cheaper than at a b separate points."""
    axis, eye = _checked(direction, stripes, view)
    surface._must_be_spatial("zebra stripes")
    normal = unit_normal(surface.grid(us, vs, 1, 0), surface.grid(us, vs, 0, 1))
    return _wave(normal, axis, eye, int(stripes))


@partial(compiled, static_argnames="stripes")
def _wave(
    normal: Float[Array, "*shape 3"], axis: Float[Array, "3"], eye: Float[Array, "3"], stripes: int
) -> Float[Array, "*shape"]:
    axis, eye = (x.astype(normal.dtype) / jnp.linalg.norm(x).astype(normal.dtype) for x in (axis, eye))
    # r . a without r: one product less, and no array of rays.
    cosine = 2 * _along(normal, eye) * _along(normal, axis) - jnp.sum(eye * axis)
    # arccos has no derivative at its ends, where the wave is at a crest.
    inside = jnp.abs(cosine) < 1
    angle = jnp.arccos(jnp.where(inside, cosine, 0.0))
    wave = jnp.where(inside, 0.5 * (1 + jnp.cos(2 * stripes * angle)), 1.0)
    return jnp.where(jnp.any(normal != 0, axis=-1), wave, jnp.nan)


def _along(vectors: Array, direction: Array) -> Array:
    return jnp.sum(vectors * jnp.broadcast_to(direction, vectors.shape), axis=-1)


def _checked(direction: Vector, stripes: int, view: Vector) -> tuple[Array, Array]:
    check_number("stripes", stripes, 1, whole=True)
    axis, eye = as_direction("direction", direction, 3), as_direction("view", view, 3)
    return jnp.asarray(axis), jnp.asarray(eye)
