"""Tensor-product B-spline surfaces."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfit._checks import is_concrete
from jaxfit._splines import _geometry
from jaxfit._splines._basis import as_parameters
from jaxfit._splines._bezier import BezierPatches, bezier_along
from jaxfit._splines._checked_arguments import (
    checked_derivative,
    checked_net,
    checked_new_knots,
    paired_parameters,
)
from jaxfit._splines._curve import BSplineCurve, affine_image
from jaxfit._splines._evaluate import contract, evaluate_grid, evaluate_surface
from jaxfit._splines._insertion import insert_in_net
from jaxfit._splines._knots import greville_abscissae


class BSplineSurface(eqx.Module):
    r"""B-spline surface $R(u, v) = \sum_{ij} P_{ij} N_{i,K}(u) N_{j,L}(v)$, equation (4).

    The orders $(K, L)$ (degree + 1) are the numbers of knots less those of control points. The
    object is a pytree with three leaves; it goes through `jit`, `vmap` and `grad`.

    Parameters
    ----------
    control_points : array (nu, nv, d)
        In any dimension d; normals and curvatures need d = 3.
    knots_u : array (nu + K,)
    knots_v : array (nv + L,)
        Non-decreasing, an interior knot at most $K$ (or $L$) times. The domain runs from knot
        $K - 1$ to knot `nu`. Unclamped vectors are fine, and so are end knots repeated more than
        $K$ times: a growing net can live in arrays of one shape, whose last control points then
        have no influence.

    Raises
    ------
    ValueError
        If the shapes do not belong together, an order is not 2 to 8, a number is not finite,
        or knots decrease, repeat too often or leave an empty domain. Inside `jit` values
        are unknown, and only shapes are checked.
    TypeError
        If the numbers are not real.

    Notes
    -----
    Evaluation costs $O(K^2 + L^2 + K L d)$ per point (NURBS Book, algorithms A3.5 and A3.6),
    and memory proportional to the result. Derivatives at a knot are those from the right, at
    the right end those from the left.

    Every evaluation takes `extrapolate=False`: parameters outside the domain are first moved to
    its nearest border, and a derivative is the one there (automatic differentiation through the
    parameter gives zero outside, and the one-sided derivative on the border). With
    `extrapolate=True` the border pieces continue. NaN in gives NaN out.

    Examples
    --------
    The bilinear patch z = u v:

    >>> net = np.array([[[0.0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 1]]])
    >>> knots = np.array([0.0, 0, 1, 1])
    >>> surface = jf.BSplineSurface(net, knots, knots)
    >>> surface(0.5, 0.5).tolist(), surface.derivative(0.5, 0.5, 1, 1).tolist()
    ([0.5, 0.5, 0.25], [0.0, 0.0, 1.0])
    >>> print(np.round(surface.normal(np.array([0.0, 1.0]), 0.0), 3) + 0.0)
    [[ 0.     0.     1.   ]
     [ 0.    -0.707  0.707]]
    """

    control_points: Float[Array, "nu nv d"]
    knots_u: Float[Array, " knots_u"]
    knots_v: Float[Array, " knots_v"]

    def __init__(self, control_points: ArrayLike, knots_u: ArrayLike, knots_v: ArrayLike):
        knots = {"knots_u": knots_u, "knots_v": knots_v}
        self.control_points, vectors = checked_net(control_points, knots)
        self.knots_u, self.knots_v = vectors["knots_u"], vectors["knots_v"]

    @property
    def order(self) -> tuple[int, int]:
        """Degree + 1 along u and along v."""
        nu, nv = self.shape
        return self.knots_u.shape[-1] - nu, self.knots_v.shape[-1] - nv

    @property
    def shape(self) -> tuple[int, int]:
        """Number of control points along u and along v."""
        nu, nv = self.control_points.shape[-3:-1]
        return nu, nv

    @property
    def dimension(self) -> int:
        """Number of coordinates d."""
        return self.control_points.shape[-1]

    @property
    def domain(self) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
        """First and last parameter along u, and along v: NumPy's numbers unless knots are traced."""
        K, L = self.order
        u, v = (np.asarray(x) if is_concrete(x) else x for x in (self.knots_u, self.knots_v))
        return (u[K - 1], u[-K]), (v[L - 1], v[-L])

    def __call__(self, u: ArrayLike, v: ArrayLike, *, extrapolate: bool = False) -> Float[Array, "*shape d"]:
        """Points at the pairs (u, v); the two broadcast against each other."""
        return self._partials(u, v, ((0, 0),), extrapolate)[0]

    def derivative(
        self, u: ArrayLike, v: ArrayLike, du: int, dv: int, *, extrapolate: bool = False
    ) -> Float[Array, "*shape d"]:
        r"""The partial derivative $\partial^{du+dv} R / \partial u^{du} \partial v^{dv}$."""
        wanted = (checked_derivative("du", du), checked_derivative("dv", dv))
        return self._partials(u, v, (wanted,), extrapolate)[0]

    def derivatives(
        self, u: ArrayLike, v: ArrayLike, count: int = 2, *, extrapolate: bool = False
    ) -> dict[tuple[int, int], Float[Array, "*shape d"]]:
        """All partial derivatives up to a total order of `count`, keyed by (du, dv).

        Cheaper than one call each: the basis functions and control points are shared.
        """
        count = checked_derivative("count", count)
        wanted = tuple((total - b, b) for total in range(count + 1) for b in range(total + 1))
        return dict(zip(wanted, self._partials(u, v, wanted, extrapolate), strict=True))

    def _partials(
        self, u: ArrayLike, v: ArrayLike, wanted: tuple[tuple[int, int], ...], extrapolate: bool
    ) -> tuple[Float[Array, "*shape d"], ...]:
        u, v = paired_parameters(u, v, self.knots_u)
        net = self.control_points
        return evaluate_surface(net, self.knots_u, self.knots_v, u, v, wanted, extrapolate)

    def grid(
        self, us: ArrayLike, vs: ArrayLike, du: int = 0, dv: int = 0, *, extrapolate: bool = False
    ) -> Float[Array, "a b d"]:
        """Points, or a partial derivative, at all combinations of `us` (a,) and `vs` (b,).

        Two one-dimensional contractions: much cheaper than a b separate points.
        """
        columns, rows = as_parameters(us, self.knots_u), as_parameters(vs, self.knots_v)
        for name, x in (("us", columns), ("vs", rows)):
            if x.ndim != 1:
                raise ValueError(
                    f"{name} must have one dimension, but has shape {x.shape}; for single pairs "
                    "of parameters call the surface itself."
                )
        wanted = (checked_derivative("du", du), checked_derivative("dv", dv))
        net = self.control_points
        return evaluate_grid(net, self.knots_u, self.knots_v, columns, rows, wanted, extrapolate)

    def normal(self, u: ArrayLike, v: ArrayLike, *, extrapolate: bool = False) -> Float[Array, "*shape 3"]:
        r"""Unit normal along $R_u \times R_v$.

        Zero where the two tangents vanish or are parallel to rounding (poles, folds): there is
        no normal there, and gradients stay finite.

        Raises
        ------
        ValueError
            If the surface is not in three dimensions.
        """
        self._must_be_spatial("normals")
        return _geometry.unit_normal(*self._partials(u, v, ((1, 0), (0, 1)), extrapolate))

    def first_form(self, u: ArrayLike, v: ArrayLike, *, extrapolate: bool = False) -> "_geometry.FirstForm":
        r"""First fundamental form $E = R_u \cdot R_u$, $F = R_u \cdot R_v$, $G = R_v \cdot R_v$."""
        return _geometry.first_form(*self._partials(u, v, ((1, 0), (0, 1)), extrapolate))

    def second_form(self, u: ArrayLike, v: ArrayLike, *, extrapolate: bool = False) -> "_geometry.SecondForm":
        r"""Second fundamental form: $R_{uu}$, $R_{uv}$ and $R_{vv}$ along the unit normal.

        Zero where `normal` is zero. Raises ValueError unless d = 3.
        """
        self._must_be_spatial("second fundamental forms")
        return _geometry.second_form(self.derivatives(u, v, 2, extrapolate=extrapolate))

    def curvature(self, u: ArrayLike, v: ArrayLike, *, extrapolate: bool = False) -> "_geometry.Curvature":
        """Gaussian, mean and principal curvatures; see `Curvature`.

        NaN where `normal` is zero. Raises ValueError unless d = 3.
        """
        self._must_be_spatial("curvatures")
        return _geometry.curvature(self.derivatives(u, v, 2, extrapolate=extrapolate))

    def greville(self) -> tuple[Float[Array, " nu"], Float[Array, " nv"]]:
        """Greville abscissae along u and along v; see `greville_abscissae`."""
        K, L = self.order
        return greville_abscissae(self.knots_u, K), greville_abscissae(self.knots_v, L)

    def insert_knots(
        self, u: ArrayLike | Sequence[float] = (), v: ArrayLike | Sequence[float] = ()
    ) -> "BSplineSurface":
        """The same surface on refined knot vectors; see `insertion_matrix`.

        Parameters
        ----------
        u, v : array (m,), default none
            New knots inside the domain, in any order, repeats allowed.

        Raises
        ------
        ValueError
            If a new knot lies outside the domain or a knot would be repeated too often.
        """
        K, L = self.order
        new_u = checked_new_knots("u", u, self.knots_u, K)
        new_v = checked_new_knots("v", v, self.knots_v, L)
        knots = self.knots_u, self.knots_v
        return BSplineSurface(*insert_in_net(self.control_points, *knots, new_u, new_v))

    def split(self) -> BezierPatches:
        """The polynomial pieces in Bezier form, one per rectangle of non-empty spans.

        Raises
        ------
        TypeError
            If the knots are traced: the number of pieces depends on their values.
        """
        net, breakpoints_u = bezier_along(self.control_points, self.knots_u, "knots_u")
        net, breakpoints_v = bezier_along(jnp.moveaxis(net, 2, 0), self.knots_v, "knots_v")
        patches = jnp.transpose(net, (2, 0, 3, 1, 4))
        return BezierPatches(patches, breakpoints_u, breakpoints_v)

    def affine(self, matrix: ArrayLike, offset: ArrayLike | None = None) -> "BSplineSurface":
        r"""The surface mapped by $x \mapsto M x + b$, `matrix` (e, d) and `offset` (e,)."""
        image = affine_image(self.control_points, matrix, offset)
        return BSplineSurface(image, self.knots_u, self.knots_v)

    def transpose(self) -> "BSplineSurface":
        """The same surface with u and v exchanged (its normals change sign)."""
        return BSplineSurface(jnp.swapaxes(self.control_points, 0, 1), self.knots_v, self.knots_u)

    def iso_u(self, u: ArrayLike, *, extrapolate: bool = False) -> BSplineCurve:
        """The curve of constant `u` (a number) on the surface, a curve in v."""
        at = as_parameters(u, self.knots_u).reshape(1)
        net = contract(self.control_points, self.knots_u, at, 0, extrapolate)
        return BSplineCurve(net[0], self.knots_v)

    def iso_v(self, v: ArrayLike, *, extrapolate: bool = False) -> BSplineCurve:
        """The curve of constant `v` (a number) on the surface, a curve in u."""
        return self.transpose().iso_u(v, extrapolate=extrapolate)

    def _must_be_spatial(self, what: str) -> None:
        if self.dimension != 3:
            raise ValueError(
                f"{what} need a surface in three dimensions, but this one has {self.dimension}; "
                "use affine() to take it there."
            )
