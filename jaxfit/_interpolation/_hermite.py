"""`NormalInterpolation`: tensor-product Hermite interpolation of points and unit normals."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._checks import as_floating, check_kind, check_number, is_concrete
from jaxfit._fit._history import ErrorHistory
from jaxfit._fit._reasons import RESULTS, code_of
from jaxfit._interpolation._gmres import distances
from jaxfit._interpolation._method import AbstractDirectInterpolation, GridProblem, Solution, single_entry
from jaxfit._interpolation._tensor_collocation import tensor_collocation
from jaxfit._parameters import AbstractParametrisation, ChordLength, grid_parameters
from jaxfit._splines import _banded as banded
from jaxfit._splines import averaging_knots

Pair = tuple[Array, Array]

LEAST_ORDER = 3
UNIT_TO = 1e-3  # how far from 1 the length of a normal may be
DEFAULT_ANGLE = {"float64": 1e-9, "float32": 1e-3}


class NormalInterpolation(AbstractDirectInterpolation):
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

    Raises
    ------
    ValueError
        If a number is out of range.
    TypeError
        If a choice is not one of its kind, or an option is no number.

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

    Examples
    --------
    >>> import jaxfit as jf
    >>> import numpy as np
    >>> x, y = np.meshgrid(np.linspace(-0.5, 0.5, 6), np.linspace(-0.5, 0.5, 5), indexing="ij")
    >>> sphere = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1)
    >>> fit = jf.interpolate(sphere, jf.NormalInterpolation(), normals=sphere)
    >>> bool(fit.converged), fit.surface.shape
    (True, (12, 10))
    """

    parametrisation: AbstractParametrisation = ChordLength()
    normal_tolerance: float | None = None

    def __check_init__(self) -> None:
        check_kind(
            "parametrisation", self.parametrisation, AbstractParametrisation, "ChordLength() or Centripetal()"
        )
        if self.normal_tolerance is not None:
            check_number("normal_tolerance", self.normal_tolerance, 0.0)

    @staticmethod
    def check_normals(normals: Any, grid: Any, order: tuple[int, int]) -> Any:
        """Unit vectors, one for each point of the grid."""
        return _checked_normals(normals, grid, order)

    def solve(self, problem: GridProblem, history: ErrorHistory) -> Solution:
        """Values, tangents and twists, and two passes of elimination."""
        data, order, frame = problem.data, problem.order, problem.frame
        normals: Any = problem.normals
        lengths = jnp.linalg.norm(normals, axis=-1, keepdims=True)
        normals = normals / jnp.where(lengths > 0, lengths, 1.0)
        parameters = grid_parameters(data, self.parametrisation)
        u, v = parameters.u, parameters.v
        tangent_u = _tangential_part(slopes(u, order[0], data, 0), normals)
        tangent_v = _tangential_part(slopes(v, order[1], data, 1), normals)
        twist = 0.5 * (slopes(v, order[1], tangent_u, 1) + slopes(u, order[0], tangent_v, 0))
        given = interleaved(interleaved(data, tangent_u, 0), interleaved(tangent_v, twist, 0), 1)
        twice = (averaging_knots(jnp.repeat(t, 2), k) for t, k in zip((u, v), order, strict=True))
        knots = next(twice), next(twice)
        tensor = tensor_collocation(knots, order, u, v, (0, 1))
        net = tensor.solve(given)
        # What the surface takes there, as it stands: values, derivatives along u and along v.
        on_rows, across_rows = deinterleaved(lax.stop_gradient(tensor.times(net)), 1)
        (values, derivative_u), (derivative_v, _) = deinterleaved(on_rows, 0), deinterleaved(across_rows, 0)
        errors = distances(lax.stop_gradient(data) - values, frame.diagonal)
        angles = angles_between(jnp.cross(derivative_u, derivative_v), lax.stop_gradient(normals))
        worst = jnp.max(angles)
        met, missed = np.int32(code_of(RESULTS.converged)), np.int32(code_of(RESULTS.normals_missed))
        code = jnp.where(worst > self._largest_angle(data.dtype), missed, met)
        code = jnp.where(jnp.max(errors) <= frame.goal, code, np.int32(code_of(RESULTS.stalled)))
        u, v = (jnp.broadcast_to(x, data.shape[:2]) for x in (u[:, None], v[None, :]))
        zero, stats = np.int32(0), {"normal_errors": angles, "maximum_normal_error": worst}
        return Solution(net, knots, u, v, errors, single_entry(errors), code, zero, zero, stats)

    def _largest_angle(self, dtype: Any) -> float:
        if self.normal_tolerance is not None:
            return self.normal_tolerance
        return DEFAULT_ANGLE.get(np.dtype(dtype).name, 1e-3)


def _checked_normals(normals: Any, grid: Any, order: tuple[int, int]) -> Any:
    if normals is None:
        raise ValueError(
            "normals must be given for NormalInterpolation; pass unit vectors in the shape of the grid."
        )
    directions = as_floating("normals", normals, 3)
    if grid.shape[2] != 3 or directions.shape != grid.shape:
        raise ValueError(
            f"normals must hold one vector in space for each point of the grid, but their shapes are "
            f"{directions.shape} and {grid.shape}; give two arrays (n, m, 3)."
        )
    if min(order) < LEAST_ORDER:
        raise ValueError(
            f"order must be at least {LEAST_ORDER} in each direction to meet normals, but is {tuple(order)}; "
            "raise it."
        )
    if is_concrete(directions):
        lengths = np.linalg.norm(np.asarray(directions), axis=-1)
        worst = np.unravel_index(np.argmax(np.abs(lengths - 1)), lengths.shape)
        if abs(lengths[worst] - 1) > UNIT_TO:
            raise ValueError(
                f"normals must be unit vectors, but the one at {tuple(int(i) for i in worst)} has length "
                f"{lengths[worst]:.3g}; divide each by its length."
            )
    return directions


def slopes(u: Array, order: int, values: Float[Array, "n m d"], axis: int) -> Float[Array, "n m d"]:
    """Derivatives at the parameters `u` of the spline through `values` along one axis."""
    knots = averaging_knots(u, order)
    net = _solved(banded.collocation_band(knots, order, u), values, axis)
    return banded.times(banded.collocation_band(knots, order, u, (1,)), net, axis=axis)


def _tangential_part(tangent: Array, normals: Array) -> Array:
    """The tangents' parts in the planes across the normals."""
    return tangent - jnp.sum(tangent * normals, axis=-1, keepdims=True) * normals


def interleaved(first: Array, second: Array, axis: int) -> Array:
    """Values and derivatives along an axis in the order of the rows of a Hermite system."""
    first, second = jnp.moveaxis(first, axis, 0), jnp.moveaxis(second, axis, 0)
    pairs = jnp.stack([first, second], axis=1)
    pairs = jnp.concatenate([pairs[:-1], pairs[-1:, ::-1]])
    return jnp.moveaxis(pairs.reshape(-1, *first.shape[1:]), 0, axis)


def deinterleaved(both: Array, axis: int) -> Pair:
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
