"""Feet as a differentiable function: the implicit derivative of the two orthogonality equations.

At a foot g = ((Q - R).R_u, (Q - R).R_v) vanishes, and g's derivative in (u, v) is minus the Hessian H of
half the squared distance. So d(u, v) = H^-1 dg, dg being taken at fixed (u, v). A coordinate held at a
border or on a crease does not move; where H is singular nothing moves, so that nothing is ever NaN.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxfit._closest._project import project
from jaxfit._closest._seeds import best_samples, sample
from jaxfit._closest._steps import AbstractFootMethod
from jaxfit._splines._evaluate import evaluate_surface
from jaxfit._splines._pieces import make_pieces

PARTIALS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def foot_parameters(
    method: AbstractFootMethod,
    control_points: Float[Array, "nu nv d"],
    knots_u: Float[Array, " knots_u"],
    knots_v: Float[Array, " knots_v"],
    points: Float[Array, "points d"],
    start: tuple[Array, Array] | None,
    tolerance: Array,
    max_steps: Array,
) -> tuple[Array, Array, Array, Array]:
    """(u, v, converged, steps); from `start`, or from the two best of a dense sample without one."""
    centre = jnp.mean(control_points, axis=(0, 1))
    pieces = make_pieces(control_points - centre[None, None, :], knots_u, knots_v)
    target = (points - centre[None, :]).T
    if start is not None:
        feet = project(method, pieces, target, *start, tolerance, max_steps)
        return feet.best_u, feet.best_v, feet.converged, feet.steps
    count = target.shape[1]
    u, v = best_samples(sample(pieces), target)
    twice = jnp.concatenate([target, target], axis=1)
    feet = project(method, pieces, twice, u.reshape(-1), v.reshape(-1), tolerance, max_steps)
    second = feet.best[count:] < feet.best[:count]

    def nearer(x: Array) -> Array:
        return jnp.where(second, x[count:], x[:count])

    return nearer(feet.best_u), nearer(feet.best_v), nearer(feet.converged), nearer(feet.steps)


@foot_parameters.defjvp
def _foot_parameters_jvp(method: AbstractFootMethod, primals: Any, tangents: Any) -> Any:
    net, knots_u, knots_v, points, _, tolerance, _ = primals
    u, v, converged, steps = foot_parameters(method, *primals)

    def slopes(net: Array, knots_u: Array, knots_v: Array, points: Array) -> tuple[Array, Array]:
        wanted = ((0, 0), (1, 0), (0, 1))
        value, along_u, along_v = evaluate_surface(net, knots_u, knots_v, u, v, wanted, False)
        e = points - value
        return jnp.sum(e * along_u, -1), jnp.sum(e * along_v, -1)

    (gu, gv), (dgu, dgv) = jax.jvp(slopes, (net, knots_u, knots_v, points), tangents[:4])
    value, ru, rv, ruu, ruv, rvv = evaluate_surface(net, knots_u, knots_v, u, v, PARTIALS, False)
    e = points - value
    E, F, G = (jnp.sum(x * y, -1) for x, y in ((ru, ru), (ru, rv), (rv, rv)))
    a, b, c = (x - jnp.sum(e * y, -1) for x, y in ((E, ruu), (F, ruv), (G, rvv)))
    order_u, order_v = knots_u.shape[0] - net.shape[0], knots_v.shape[0] - net.shape[1]
    free_u = _free(u, gu, E, knots_u, order_u, tolerance)
    free_v = _free(v, gv, G, knots_v, order_v, tolerance)
    du, dv = _solve(a, b, c, E, G, dgu, dgv, free_u, free_v)
    zero = partial(jnp.zeros, dtype=jax.dtypes.float0)
    return (u, v, converged, steps), (du, dv, zero(converged.shape), zero(steps.shape))


def _free(u: Array, g: Array, E: Array, knots: Array, order: int, tolerance: Array) -> Array:
    """Whether a coordinate moves: neither pushed against a border nor, on a crease, off balance."""
    low, high = knots[order - 1], knots[-order]
    pushed = ((u <= low) & (g < 0)) | ((u >= high) & (g > 0))
    scale = jnp.sqrt(jnp.finfo(u.dtype).eps)
    balanced = g * g <= (100.0 * tolerance) ** 2 * E + scale * jnp.finfo(u.dtype).tiny
    return ~pushed & balanced & (E > 0)


def _solve(
    a: Array,
    b: Array,
    c: Array,
    E: Array,
    G: Array,
    x: Array,
    y: Array,
    free_u: Array,
    free_v: Array,
) -> tuple[Array, Array]:
    """[[a, b], [b, c]]^-1 (x, y) on the free coordinates, zero where that is singular."""
    eps = jnp.finfo(x.dtype).eps
    both = free_u & free_v
    determinant = a * c - b * b
    regular = both & (jnp.abs(determinant) > eps * E * G)
    inverse = jnp.where(regular, 1.0 / jnp.where(regular, determinant, 1.0), 0.0)
    along_u = free_u & ~free_v & (jnp.abs(a) > eps * E)
    along_v = free_v & ~free_u & (jnp.abs(c) > eps * G)
    du = (c * x - b * y) * inverse + jnp.where(along_u, x / jnp.where(along_u, a, 1.0), 0.0)
    dv = (a * y - b * x) * inverse + jnp.where(along_v, y / jnp.where(along_v, c, 1.0), 0.0)
    return du, dv
