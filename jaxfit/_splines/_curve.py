"""B-spline curves."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfit._splines._basis import as_parameters
from jaxfit._splines._bezier import BezierCurves, bezier_along
from jaxfit._splines._checked_arguments import checked_derivative, checked_net, checked_new_knots
from jaxfit._splines._evaluate import evaluate_curve
from jaxfit._splines._insertion import insert_along
from jaxfit._splines._knots import greville_abscissae


class BSplineCurve(eqx.Module):
    r"""B-spline curve $C(u) = \sum_i P_i N_{i,K}(u)$ in any number of dimensions.

    The order $K$ (degree + 1) is the number of knots less the number of control points. The
    object is a pytree with two leaves; it goes through `jit`, `vmap` and `grad`.

    Parameters
    ----------
    control_points : array (n, d)
    knots : array (n + K,)
        Non-decreasing, an interior knot at most $K$ times. The domain is
        $[t_{K-1}, t_n]$; unclamped vectors are fine, and so are end knots repeated more than $K$
        times (their surplus control points have no influence).

    Raises
    ------
    ValueError
        If the shapes do not belong together, the order is not 2 to 8, a number is not finite,
        or the knots decrease, repeat too often or leave an empty domain. Inside `jit` values
        are unknown, and only shapes are checked.
    TypeError
        If the numbers are not real.

    Notes
    -----
    Evaluation costs $O(K^2 + K d)$ per parameter (NURBS Book, algorithms A3.1 and A3.2). The
    derivative at a knot is the one from the right, at the right end the one from the left.
    Parameters outside the domain are moved to its nearest end unless `extrapolate=True`, which
    continues the end pieces; NaN in gives NaN out.

    Examples
    --------
    A parabola, its point and its tangent in the middle:

    >>> points, knots = np.array([[0.0, 0.0], [0.5, 1.0], [1.0, 0.0]]), np.array([0.0, 0, 0, 1, 1, 1])
    >>> curve = jf.BSplineCurve(points, knots)
    >>> curve.order, curve(0.5).tolist(), curve.derivative(0.5).tolist()
    (3, [0.5, 0.5], [1.0, 0.0])
    """

    control_points: Float[Array, "n d"]
    knots: Float[Array, " knots"]

    def __init__(self, control_points: ArrayLike, knots: ArrayLike):
        self.control_points, vectors = checked_net(control_points, {"knots": knots})
        self.knots = vectors["knots"]

    @property
    def order(self) -> int:
        """Degree + 1."""
        return self.knots.shape[-1] - self.control_points.shape[-2]

    @property
    def dimension(self) -> int:
        """Number of coordinates d."""
        return self.control_points.shape[-1]

    @property
    def domain(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """First and last parameter."""
        return self.knots[self.order - 1], self.knots[-self.order]

    def __call__(self, u: ArrayLike, *, extrapolate: bool = False) -> Float[Array, "*shape d"]:
        """Points at parameters `u` of any shape."""
        return self.derivative(u, 0, extrapolate=extrapolate)

    def derivative(self, u: ArrayLike, du: int = 1, *, extrapolate: bool = False) -> Float[Array, "*shape d"]:
        """The `du`-th derivative at parameters `u` (zero from the order on).

        Outside the domain it is the derivative at the nearest end, or that of the continued
        piece with `extrapolate=True`.
        """
        du = checked_derivative("du", du)
        parameters = as_parameters(u, self.knots)
        return evaluate_curve(self.control_points, self.knots, parameters, du, extrapolate)

    def greville(self) -> Float[Array, " n"]:
        """Greville abscissae, one per control point; see `greville_abscissae`."""
        return greville_abscissae(self.knots, self.order)

    def insert_knots(self, new_knots: ArrayLike | Sequence[float]) -> "BSplineCurve":
        """The same curve on a refined knot vector; see `insertion_matrix`.

        Raises
        ------
        ValueError
            If a new knot lies outside the domain or a knot would be repeated too often.
        """
        inserted = checked_new_knots("new_knots", new_knots, self.knots, self.order)
        return BSplineCurve(*insert_along(self.control_points, self.knots, inserted))

    def split(self) -> BezierCurves:
        """The polynomial pieces in Bezier form, one per non-empty span.

        Raises
        ------
        TypeError
            If the knots are traced: the number of pieces depends on their values.
        """
        return BezierCurves(*bezier_along(self.control_points, self.knots, "knots"))

    def affine(self, matrix: ArrayLike, offset: ArrayLike | None = None) -> "BSplineCurve":
        """The curve mapped by $x \\mapsto M x + b$, `matrix` (e, d) and `offset` (e,)."""
        return BSplineCurve(affine_image(self.control_points, matrix, offset), self.knots)


def affine_image(points: Array, matrix: ArrayLike, offset: ArrayLike | None) -> Array:
    """Points (..., d) mapped by a matrix (e, d) and an offset (e,)."""
    matrix = jnp.asarray(matrix)
    if matrix.ndim != 2 or matrix.shape[1] != points.shape[-1]:
        raise ValueError(
            f"matrix must have shape (e, {points.shape[-1]}) to map {points.shape[-1]} "
            f"coordinates, but has shape {matrix.shape}; transpose or resize it."
        )
    image = jnp.matmul(points, matrix.T, precision=lax.Precision.HIGHEST)
    if offset is None:
        return image
    offset = jnp.asarray(offset)
    if offset.shape not in ((), (matrix.shape[0],)):
        raise ValueError(
            f"offset must have shape ({matrix.shape[0]},), but has shape {offset.shape}; give one "
            "number per mapped coordinate."
        )
    return image + jnp.broadcast_to(offset, image.shape)
