"""The area of a trimmed surface, and its derivatives."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit._checks import is_concrete
from jaxfit._splines import BSplineSurface
from jaxfit._trimmed._checked_loops import Loop, edges_of
from jaxfit._trimmed._quadrature import Nodes, along_edges, quadrature
from jaxfit._unrolling import root_with_slope

Loops = tuple[Float[Array, "_ 2"], ...]


def area_inside(surface: BSplineSurface, loops: Loops) -> Float[Array, ""]:
    """The integral of the surface element over the region inside loops that are known."""
    return _sum_at(quadrature(edges_of(on_host(loops)), *knot_lines(surface)), surface)


@jax.custom_jvp
def area_of_loops(surface: BSplineSurface, loops: Loops) -> Float[Array, ""]:
    """The same, differentiable in the loops as well; not under `jit`."""
    if not is_concrete(loops, surface):
        raise TypeError(
            "loops must be known, for the number of nodes depends on their values, but are traced by jit or "
            "vmap; close over them, or take jax.grad without jit."
        )
    return area_inside(surface, loops)


@area_of_loops.defjvp
def _area_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    r"""A vertex that moves by d moves its edges: dA = \oint |R_u x R_v| (d_u dv - d_v du)."""
    (surface, loops), (surface_move, loop_moves) = primals, tangents
    edges = edges_of(on_host(loops))
    nodes = quadrature(edges, *knot_lines(surface))
    value, change = jax.jvp(partial(_sum_at, nodes), (surface,), (surface_move,))
    owner, share, places, weight = along_edges(edges, *knot_lines(surface))
    moves = jnp.concatenate([jnp.stack([d, jnp.roll(d, -1, axis=0)], axis=1) for d in loop_moves])[owner]
    at = jnp.asarray(share, moves.dtype)[:, None]
    d_u, d_v = ((1 - at) * moves[:, 0] + at * moves[:, 1]).T
    along = jnp.asarray(weight[:, None] * (edges[owner, 1] - edges[owner, 0]), moves.dtype)
    swept = d_u * along[:, 1] - d_v * along[:, 0]
    return value, change + jnp.sum(swept * _element(surface, *places.T))


def _sum_at(nodes: Nodes, surface: BSplineSurface) -> Float[Array, ""]:
    weight = jnp.asarray(nodes.weight, surface.control_points.dtype)
    return jnp.sum(weight * _element(surface, nodes.u, nodes.v))


def _element(surface: BSplineSurface, u: np.ndarray, v: np.ndarray) -> Float[Array, " nodes"]:
    """|R_u x R_v|; zero where the normal vanishes, with a gradient of zero."""
    dtype = surface.control_points.dtype
    at = jnp.asarray(u, dtype), jnp.asarray(v, dtype)
    normal = jnp.cross(surface.derivative(*at, 1, 0), surface.derivative(*at, 0, 1))
    return root_with_slope(jnp.sum(normal**2, axis=-1))


def on_host(loops: Loops) -> list[Loop]:
    """The loops as NumPy arrays in double precision."""
    return [np.asarray(loop, np.float64) for loop in loops]


def knot_lines(surface: BSplineSurface) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]]:
    """The distinct knots in the domain along u, and along v."""
    lines = []
    for knots, (low, high) in zip((surface.knots_u, surface.knots_v), domain_of(surface), strict=True):
        lines.append(np.unique(np.clip(np.asarray(knots, np.float64), low, high)))
    return lines[0], lines[1]


def domain_of(surface: BSplineSurface) -> Float[np.ndarray, "2 2"]:
    """First and last u, first and last v, on the host."""
    return np.asarray(surface.domain, np.float64)
