"""`TrimmedSurface`: a surface over the region inside loops."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfit._checks import check_kind, is_concrete
from jaxfit._splines import BSplineSurface
from jaxfit._splines._checked_arguments import paired_parameters
from jaxfit._trimmed._area import area_inside, area_of_loops, domain_of, knot_lines, on_host
from jaxfit._trimmed._checked_loops import Edges, Loop, checked_loops, edges_of
from jaxfit._trimmed._inside import inside_loops, inside_on_host
from jaxfit._trimmed._tessellation import DEVIATION, Tessellation, tessellate


class TrimmedSurface(eqx.Module):
    r"""The part of a B-spline surface whose parameters are inside closed polylines, its loops.

    The region is inside the first loop and outside all others. The object is a pytree; it goes through
    `jit`, `vmap` and `grad`.

    Parameters
    ----------
    surface : BSplineSurface
    loops : sequence of arrays (vertices, 2)
        Closed polylines in (u, v), with or without the first vertex at the end: the outer loop first, then
        the holes. They are kept counter-clockwise and clockwise, whichever way they were given, so that the
        region is to the left of each. Vertices that lie outside the domain by rounding are moved onto it.

    Raises
    ------
    ValueError
        If there is no loop, or one has fewer than three vertices, is not finite, leaves the domain, or
        touches itself or another; or if a hole is not inside the outer loop, or is inside another hole.
        Inside `jit` values are unknown, and only shapes are checked.
    TypeError
        If `surface` is no BSplineSurface.

    Examples
    --------
    A square sheet with a round hole:

    >>> x, y = np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 1, 4), indexing="ij")
    >>> knots = jf.clamped_uniform_knots(4, 4)
    >>> surface = jf.BSplineSurface(np.stack([x, y, 0 * x], axis=2), knots, knots)
    >>> angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    >>> hole = 0.5 + 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    >>> square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> trimmed = jf.TrimmedSurface(surface, (square, hole))
    >>> trimmed.contains(np.array([0.5, 0.1]), 0.5).tolist()
    [False, True]
    >>> print(round(float(trimmed.area()), 4), round(1 - 0.04 * np.pi, 4))
    0.8743 0.8743
    >>> print(trimmed(0.5, np.array([0.5, 0.1])).round(3))
    [[nan nan nan]
     [0.5 0.1 0. ]]
    """

    surface: BSplineSurface
    loops: tuple[Float[Array, "_ 2"], ...]

    def __init__(self, surface: BSplineSurface, loops: Sequence[ArrayLike]):
        check_kind("surface", surface, BSplineSurface, "a BSplineSurface")
        given = list(loops)
        if not given:
            raise ValueError("loops must hold at least the outer loop, but is empty; give one.")
        if is_concrete(given, surface.knots_u, surface.knots_v):
            given = list(checked_loops(given, domain_of(surface)))
        self.surface = surface
        self.loops = tuple(jnp.asarray(loop, surface.control_points.dtype) for loop in given)

    @property
    def holes(self) -> int:
        """How many loops there are after the outer one."""
        return len(self.loops) - 1

    def contains(self, u: ArrayLike, v: ArrayLike) -> Bool[Array, "*shape"]:
        """Whether the parameters (u, v) are inside the loops; the two broadcast against each other.

        On a loop itself either answer may come, and NaN is outside.
        """
        u, v = paired_parameters(u, v, self.surface.knots_u)
        if is_concrete(u, v, self.loops):
            points = np.stack([np.asarray(u, float).reshape(-1), np.asarray(v, float).reshape(-1)], axis=1)
            return jnp.asarray(inside_on_host(loop_edges(self), points).reshape(u.shape))
        loops = [jnp.stack([loop, jnp.roll(loop, -1, axis=0)], axis=1) for loop in self.loops]
        return inside_loops(jnp.concatenate(loops), u, v)

    def __call__(self, u: ArrayLike, v: ArrayLike) -> Float[Array, "*shape d"]:
        """Points of the surface at the pairs (u, v), NaN outside the loops.

        `trimmed.surface(u, v)` gives points there, too.
        """
        return jnp.where(self.contains(u, v)[..., None], self.surface(u, v), jnp.nan)

    def area(self) -> Float[Array, ""]:
        r"""$\int |R_u \times R_v|\, du\, dv$ over the region.

        Gauss's rule on every cell, and by Green's theorem on what remains of the cells that a loop crosses:
        loops are followed exactly. To 1e-9 and better on smooth surfaces; less where the normal nearly
        vanishes. Differentiable in the control points, and by `jax.grad` in the loops, which must then
        have the region to their left.

        Raises
        ------
        TypeError
            If the loops or knots are traced by `jit` or `vmap`: the number of nodes depends on their values.
        ValueError
            If the surface is not in three dimensions.
        """
        if self.surface.dimension != 3:
            raise ValueError(
                f"surface must be in three dimensions to have an area, but has {self.surface.dimension}; use "
                "affine() to take it there."
            )
        if is_concrete(self.loops, self.surface.knots_u, self.surface.knots_v):
            return area_inside(self.surface, self.loops)
        return area_of_loops(self.surface, self.loops)

    def tessellate(self, deviation: float = DEVIATION) -> Tessellation:
        """Triangles whose sides are within `deviation` of the surface, and which follow the loops.

        Parameters
        ----------
        deviation : float
            The largest distance halfway along the side of a triangle, as a fraction of the diagonal of the
            control points (default 1e-4).

        Returns
        -------
        Tessellation
            `vertices`, `triangles`, `u` and `v`, made by NumPy in double precision.

        Raises
        ------
        TypeError
            If the surface or the loops are traced: the number of triangles depends on their values.
        ValueError
            If `deviation` is not positive, or loops are too close to each other for triangles.
        """
        if not is_concrete(self):
            raise TypeError("the trimmed surface must be known before tracing, but is traced; close over it.")
        if not deviation > 0:
            raise ValueError(f"deviation must be positive, but is {deviation!r}; pass for instance 1e-4.")
        return tessellate(self.surface, host_loops(self), knot_lines(self.surface), float(deviation))


def host_loops(trimmed: TrimmedSurface) -> list[Loop]:
    """The loops as NumPy arrays in double precision."""
    return on_host(trimmed.loops)


def loop_edges(trimmed: TrimmedSurface) -> Edges:
    """Start and end of every edge of the loops, on the host."""
    return edges_of(host_loops(trimmed))
