"""Reflectional symmetry of grids and nets: the plane, the projection, symmetric parameters and knots."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfit._checks import as_direction, as_floating, as_vector, is_concrete
from jaxfit._splines import _reflection_kernels as kernels

Vector = ArrayLike | Sequence[float | int]


class Reflection(eqx.Module):
    r"""Reflectional symmetry: row $i$ of a grid is the mirror image of row $n - 1 - i$.

    The mirror image about the plane through $c$ with unit normal $\mathbf n$ is
    $M x = x - 2\,((x - c) \cdot \mathbf n)\,\mathbf n$. The symmetric grids form a linear subspace, and the
    orthogonal projection onto it is

    $$Q_{ij} \leftarrow \tfrac12 (Q_{ij} + M Q_{n-1-i,\,j}).$$

    Unless told, the plane passes through the centroid of the grid (as in the paper), and its normal makes
    the deviations $\sum |Q_{ij} - M Q_{n-1-i,j}|^2$ least. With differences $D$ and midpoints $m$ of the
    pairs it is the leading eigenvector of $\sum D D^T - 4 \sum (m - c)(m - c)^T$. On symmetric data that
    is the paper's mean direction between paired points. But no pair needs a sign, so it also holds where
    the surface reaches across its own plane, and a middle row counts as well.

    Parameters
    ----------
    axis : 0 or 1
        The index of the grid that is paired: 0 for rows, 1 for columns (default 0).
    point, normal : array (d,), optional
        A point on the plane, and its normal, of any length and sign. What is not given is found from the
        grid.

    Raises
    ------
    ValueError
        If `axis` is neither 0 nor 1, `normal` is zero, or the shapes differ.

    Notes
    -----
    Section 3.2 of Kineri, Wang, Lin and Maekawa (2012), corrected. As printed, equations (15) and (16)
    average absolute coordinates and put the signs back. That is a reflection only where every point keeps to
    its own side of a coordinate plane; elsewhere an error vector, whose components may have any sign,
    turns into another one, and the net drifts away. Nor is it enough to project every error
    vector: the feet of a pair that is not quite symmetric have different normals and weights, so that
    projected errors vanish only up to that difference, and the iteration stalls. Symmetric data,
    parameters, knots and weights, made once, need no correction at all: each step of the iteration then
    maps symmetric nets to symmetric nets.

    Works in any dimension and under `jit`, `vmap` and `grad`; first derivatives of a plane that is found
    are exact. Inside transformations values cannot be checked: where the plane is undetermined, its normal
    is then arbitrary, and finite.

    Examples
    --------
    >>> import jaxfit as jf
    >>> import numpy as np
    >>> x, y = np.meshgrid([-1.0, 0.0, 1.5], [0.0, 1.0], indexing="ij")
    >>> grid = np.stack([x, y, x**2], axis=-1)
    >>> reflection = jf.Reflection(axis=0, point=(0, 0, 0), normal=(1, 0, 0))
    >>> print(np.round(reflection.symmetrise_points(grid)[:, 0, 0], 8))
    [-1.25  0.    1.25]
    >>> print(round(float(reflection.asymmetry(grid)), 4))
    1.3463
    """

    axis: int = eqx.field(static=True)
    point: Float[Array | np.ndarray, " d"] | None
    normal: Float[Array | np.ndarray, " d"] | None

    def __init__(self, axis: int = 0, point: Vector | None = None, normal: Vector | None = None):
        if isinstance(axis, bool) or axis not in (0, 1):
            raise ValueError(f"axis must be 0 (rows) or 1 (columns), but is {axis!r}; name the paired index.")
        self.axis = int(axis)
        self.point = None if point is None else as_vector("point", point)
        self.normal = None if normal is None else as_direction("normal", normal)
        if self.point is not None and self.normal is not None and self.point.shape != self.normal.shape:
            raise ValueError(
                f"point and normal must have as many coordinates, but have {self.point.shape[0]} and "
                f"{self.normal.shape[0]}; give both in the dimension of the grid."
            )

    def plane(self, grid: ArrayLike) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
        """A point on the plane of symmetry of `grid` (n, m, d), and its unit normal.

        A normal that is found points from the first rows to the last; a given one keeps its sign.

        Raises
        ------
        ValueError
            If no direction stands out among the differences of pairs: they vanish, or they point
            every way alike. Give the normal then.
        """
        rows = self._rows("grid", grid)
        point = jnp.mean(rows, axis=(0, 1)) if self.point is None else jnp.asarray(self.point, rows.dtype)
        if self.normal is not None:
            return point, kernels.unit(jnp.asarray(self.normal, rows.dtype))
        normal, clear = kernels.best_normal(rows, point)
        if is_concrete(clear) and not bool(clear):
            raise ValueError(
                "grid has no plane of symmetry for this pairing, since the differences between paired "
                f"points have no common direction; pair the other index than axis={self.axis}, or give "
                "the normal."
            )
        return point, normal

    def located(self, grid: ArrayLike) -> "Reflection":
        """The same symmetry with its plane held fixed: the one found in `grid` (n, m, d)."""
        return Reflection(self.axis, *self.plane(grid))

    def in_unit(self, centre: ArrayLike, scale: ArrayLike) -> "Reflection":
        """The same symmetry for points $(x - c) / s$, with `centre` c (d,) and `scale` s a number."""
        if self.point is None:
            return self
        concrete = is_concrete(self.point, centre, scale)
        point: Any = np.asarray(self.point, np.float64) if concrete else self.point
        return Reflection(self.axis, (point - centre) / scale, self.normal)

    def mirror(self, points: ArrayLike) -> Float[Array, "*shape d"]:
        """Mirror images of points (..., d).

        Raises
        ------
        ValueError
            If the plane is not known: neither given nor found by `located`.
        """
        if self.point is None or self.normal is None:
            raise ValueError(
                "this Reflection has no plane yet, so nothing can be mirrored; give it a point and a "
                "normal, or take the one that located(grid) returns."
            )
        array = jnp.asarray(as_floating("points", points, np.ndim(points)))
        self._check_dimension("points", array)
        point, normal = (jnp.asarray(x, array.dtype) for x in (self.point, self.normal))
        return kernels.mirrored(array, point, kernels.unit(normal))

    def symmetrise_points(self, grid: ArrayLike) -> Float[Array, "n m d"]:
        """The symmetric grid nearest to `grid` (n, m, d), in the sense of least squares.

        The last rows are made as `mirror` images of the first ones, so that outside transformations
        the two agree to the last bit; the middle row of an odd number lies in the plane, to rounding.
        Corners move, too. Raises ValueError as `plane` does.
        """
        rows = self._rows("grid", grid)
        point, normal = self.plane(grid)
        half = rows.shape[0] // 2
        first = kernels.averaged(rows[:half], rows[::-1][:half], point, normal)
        middle = kernels.onto_plane(rows[half : rows.shape[0] - half], point, normal)
        last = kernels.mirrored(first, point, normal)[::-1]
        return jnp.moveaxis(jnp.concatenate([first, middle, last]), 0, self.axis)

    def symmetrise_parameters(self, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        r"""Symmetric parameters on [0, 1], either one vector per direction or one pair per point.

        Of the paired direction $t_i \leftarrow (t_i + 1 - t_{n-1-i}) / 2$. Of the other one vectors stay
        as they are, and each point's own parameter becomes the mean of its pair. Increasing
        parameters stay increasing, and their pairs sum to 1 (or are equal) to the last bit.

        Parameters
        ----------
        u, v : arrays (n,) and (m,), or both (n, m)
            Along the first and the second index of the grid.
        """
        u, v = (jnp.asarray(as_floating(name, x, np.ndim(x))) for name, x in (("u", u), ("v", v)))
        if u.ndim != v.ndim or u.ndim not in (1, 2) or (u.ndim == 2 and u.shape != v.shape):
            raise ValueError(
                f"u and v must be two vectors or two arrays of one shape (n, m), but have shapes {u.shape} "
                f"and {v.shape}; give the parameters of one grid."
            )
        both = [u, v]
        ends = [jnp.asarray(x, u.dtype) for x in (0.0, 1.0)]
        both[self.axis] = self._along(lambda t: kernels.reversal_mean(t, *ends), both[self.axis])
        if u.ndim == 2:
            both[1 - self.axis] = self.symmetrise_values(both[1 - self.axis])
        return both[0], both[1]

    def symmetrise_knots(self, knots: ArrayLike) -> Float[Array, " knots"]:
        r"""Clamped knots of the paired direction, $k_i \leftarrow (k_i + k_0 + k_{last} - k_{last-i}) / 2$.

        Ends, order and multiplicities stay; on [0, 1] pairs sum to 1 to the last bit. The knots of the
        other direction need nothing.
        """
        values = jnp.asarray(as_floating("knots", knots, 1))
        return kernels.reversal_mean(values, values[0], values[-1])

    def symmetrise_values(self, values: ArrayLike) -> Array:
        """The mean of each pair of numbers (n, m), such as weights of the points of a grid."""
        array = jnp.asarray(as_floating("values", values, 2))
        return (array + jnp.flip(array, self.axis)) / 2

    def asymmetry(self, net: ArrayLike) -> Float[Array, ""]:
        r"""The largest distance $|P_{ij} - M P_{n-1-i,j}|$ of a net (n, m, d) from its mirror image.

        In the unit of the net; a plane that is not known is found from the net itself. It is zero after
        `symmetrise_points` about a known plane, but for rounding in a middle row.
        """
        rows = self._rows("net", net)
        point, normal = self.plane(net)
        half = (rows.shape[0] + 1) // 2
        # An isometry that is its own inverse: the other half deviates as much.
        return kernels.largest_distance(
            kernels.mirrored(rows[:half], point, normal), rows[rows.shape[0] - half :][::-1]
        )

    def _rows(self, name: str, grid: ArrayLike) -> Array:
        """The grid with its paired index in front."""
        array = jnp.asarray(as_floating(name, grid, 3))
        if array.shape[self.axis] < 2 or not array.size:
            raise ValueError(
                f"{name} must hold at least two points along index {self.axis}, which is paired, but has "
                f"shape {array.shape}; give an array (n, m, d)."
            )
        self._check_dimension(name, array)
        return jnp.moveaxis(array, self.axis, 0)

    def _check_dimension(self, name: str, array: Array) -> None:
        for own, vector in (("point", self.point), ("normal", self.normal)):
            if vector is not None and array.shape[-1:] != vector.shape:
                raise ValueError(
                    f"{name} must have as many coordinates as the {own} of the plane, "
                    f"{vector.shape[0]}, but has shape {array.shape}; give both in one dimension."
                )

    def _along(self, change: Any, values: Array) -> Array:
        """`change` applied along the paired index, or to a vector."""
        axis = self.axis if values.ndim == 2 else 0
        return jnp.moveaxis(change(jnp.moveaxis(values, axis, 0)), 0, axis)
