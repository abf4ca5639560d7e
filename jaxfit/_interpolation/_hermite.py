"""Interpolation of grids whose points have unit normals: tensor-product Hermite interpolation."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._checks import check_kind, check_number
from jaxfit._interpolation._outcome import extent_of
from jaxfit._parameters import AbstractParametrisation, ChordLength, grid_parameters
from jaxfit._splines import _banded as banded
from jaxfit._splines import averaging_knots

Pair = tuple[Array, Array]


class NormalInterpolation(eqx.Module):
    r"""Pass through every point of a grid with the tangent plane that its normal asks for.

    A tensor-product spline with twice as many control points as data points in each direction is fixed by
    its values, first derivatives and twists at the averaged parameters, and always exists. Values are the
    data. First derivatives are those of the spline through the data, $R_u$, with what sticks out of the
    tangent plane taken away, $T_u = R_u - (R_u \cdot \mathbf n)\,\mathbf n$, and likewise $T_v$: the least
    change that meets the normals. The twists are the mean of $\partial_v T_u$ and $\partial_u T_v$, each by
    a spline through the grid of these derivatives. So where the given normals are those of a spline through
    the data, derivatives and twists are that spline's.

    Two passes of banded elimination, $O(nm)$ in all, and no iteration.

    Parameters
    ----------
    parametrisation : ChordLength() or Centripetal()
        Of the grid's rows and columns; its averages are the parameters, and give the knots (5), each
        counted twice.
    normal_tolerance : float
        The largest angle allowed between the surface's normal and a given one, in radians. Default 1e-9 in
        float64, 1e-3 in float32.

    Notes
    -----
    Normals may all point to either side of the surface. Where one lies nearly in the surface through the
    data, or points to the other side than the rest, a regular surface would have to fold: the fit then ends
    with `RESULTS.normals_missed`, on the surface as computed. `Fit.stats` holds `normal_errors` (n, m), the
    angles in radians, and `maximum_normal_error`.

    Angles are those of the net before it is rounded to the user's coordinates, far from the origin.

    Normals far from those of the surface through the data alone are met all the same, by ripples as wide as
    the distance of two points.

    Needs order 3 or more in each direction and points in space (d = 3). Derivatives in data and normals are
    exact.

    The extension announced at the end of Kineri, Wang, Lin and Maekawa (2012); Gofuku, Tamura and Maekawa
    (CAD 41, 2009) meet the normals of curves by iteration.
    """

    parametrisation: AbstractParametrisation = ChordLength()
    normal_tolerance: float | None = None

    def __check_init__(self) -> None:
        check_kind("parametrisation", self.parametrisation, AbstractParametrisation, "ChordLength()")
        if self.normal_tolerance is not None:
            check_number("normal_tolerance", self.normal_tolerance, 0.0)


class NormalSolution(eqx.Module):
    """What the traced part returns; lengths in the problem's unit."""

    net: Float[Array, "nu nv d"]
    knots: Pair
    parameters: Pair
    residual: Float[Array, "n m"]  # distances of the data from the surface at the parameters
    angles: Float[Array, "n m"]
    extent: Float[Array, "2"]


@partial(jax.jit, static_argnames=("method", "order"))
def solved_with_normals(
    method: NormalInterpolation,
    order: tuple[int, int],
    data: Float[Array, "n m 3"],
    normals: Float[Array, "n m 3"],
) -> NormalSolution:
    """The whole fit."""
    parameters = grid_parameters(data, method.parametrisation)
    u, v = parameters.u, parameters.v
    tangent_u = _flattened(slopes(u, order[0], data, 0), normals)
    tangent_v = _flattened(slopes(v, order[1], data, 1), normals)
    twist = 0.5 * (slopes(v, order[1], tangent_u, 1) + slopes(u, order[0], tangent_v, 0))
    given = interleaved(interleaved(data, tangent_u, 0), interleaved(tangent_v, twist, 0), 1)
    knots = [averaging_knots(jnp.repeat(t, 2), k) for t, k in zip((u, v), order, strict=True)]
    bands = [banded.collocation_band(t, k, x, (0, 1)) for t, k, x in zip(knots, order, (u, v), strict=True)]
    net = _solved(bands[1], _solved(bands[0], given, 0), 1)
    # What the surface takes there, as it stands: values, derivatives along u and along v.
    met = lax.stop_gradient(banded.times(bands[1], banded.times(bands[0], net, axis=0), axis=1))
    on_rows, across_rows = parted(met, 1)
    (values, derivative_u), (derivative_v, _) = parted(on_rows, 0), parted(across_rows, 0)
    residual = jnp.sqrt(jnp.sum((lax.stop_gradient(data) - values) ** 2, axis=-1))
    angles = angles_between(jnp.cross(derivative_u, derivative_v), lax.stop_gradient(normals))
    return NormalSolution(net, (knots[0], knots[1]), (u, v), residual, angles, extent_of(data))


def slopes(u: Array, order: int, values: Float[Array, "n m d"], axis: int) -> Float[Array, "n m d"]:
    """Derivatives at the parameters `u` of the spline through `values` along one axis."""
    knots = averaging_knots(u, order)
    net = _solved(banded.collocation_band(knots, order, u), values, axis)
    return banded.times(banded.collocation_band(knots, order, u, (1,)), net, axis=axis)


def _flattened(tangent: Array, normals: Array) -> Array:
    """The tangents' parts in the planes across the normals."""
    return tangent - jnp.sum(tangent * normals, axis=-1, keepdims=True) * normals


def interleaved(first: Array, second: Array, axis: int) -> Array:
    """Values and derivatives along an axis in the order of the rows of a Hermite system."""
    first, second = jnp.moveaxis(first, axis, 0), jnp.moveaxis(second, axis, 0)
    pairs = jnp.stack([first, second], axis=1)
    pairs = jnp.concatenate([pairs[:-1], pairs[-1:, ::-1]])
    return jnp.moveaxis(pairs.reshape(-1, *first.shape[1:]), 0, axis)


def parted(both: Array, axis: int) -> Pair:
    """Values and derivatives, the inverse of `interleaved`."""
    rows = jnp.moveaxis(both, axis, 0)
    pairs = rows.reshape(-1, 2, *rows.shape[1:])
    pairs = jnp.concatenate([pairs[:-1], pairs[-1:, ::-1]])
    return jnp.moveaxis(pairs[:, 0], 0, axis), jnp.moveaxis(pairs[:, 1], 0, axis)


def _solved(band: Array, right: Array, axis: int) -> Array:
    rows = jnp.moveaxis(right, axis, 0)
    return jnp.moveaxis(banded.solve(band, rows.reshape(rows.shape[0], -1)).reshape(rows.shape), 0, axis)


def angles_between(across: Float[Array, "n m 3"], normals: Float[Array, "n m 3"]) -> Float[Array, "n m"]:
    """Angles between the surface's normals, of any length, and the given ones, up to one sign for all.

    Where the surface has no normal, the angle is a right one.
    """
    along = jnp.sum(across * normals, axis=-1)
    aside = jnp.linalg.norm(jnp.cross(across, normals), axis=-1)
    side = jnp.where(jnp.sum(jnp.sign(along)) < 0, -1.0, 1.0)
    none: Bool[Array, "n m"] = (along == 0) & (aside == 0)
    return jnp.arctan2(jnp.where(none, 1.0, aside), side * along)
