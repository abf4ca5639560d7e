"""The derivative of foot points, by the implicit function theorem.

At a foot g = ((Q - R).R_u, (Q - R).R_v) vanishes, and the derivative of g in (u, v) is -H, H being the
Hessian of half the squared distance. So d(u, v) = H^-1 dg, with dg taken at fixed (u, v). Coordinates at an
active bound or on a crease have the derivative 0, and so have feet with a singular H: no derivative is NaN.
"""

from functools import partial, reduce
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._cells._polynomials import PARTIALS, Jet
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._forms import dot
from jaxfit._closest._project import ParameterBounds, project
from jaxfit._closest._samples import best_samples, sample_points
from jaxfit._splines._evaluate import evaluate_surface
from jaxfit._splines._pieces import Pieces, make_pieces

Arrays = tuple[Array, Array, Array]  # control points and both knot vectors
FOOT_TOLERANCE = 1e-2  # roots of the rounding unit, over 100: tangential residuals beyond this are a crease's


def searched_feet(
    method: AbstractFootMethod,
    surface: Arrays,
    points: Float[Array, "points d"],
    start: tuple[Array, Array] | None,
    tolerance: Array,
    max_steps: Array,
) -> tuple[Array, Array, Array, Array]:
    """(u, v, converged, steps); from `start`, or from the two best of a dense sample without one.

    They are constants to a derivative; `as_feet` makes them follow surface and points.
    """
    fixed = lax.stop_gradient((surface, points, start, tolerance, max_steps))
    search = partial(_found, method)
    if (
        jax.default_backend() == "cpu"
    ):  # a batch one by one: an ordinary vmap would compute both branches of every condition
        search = jax.custom_batching.sequential_vmap(search)
    return search(*fixed)


def _found(
    method: AbstractFootMethod,
    surface: Arrays,
    points: Array,
    start: tuple[Array, Array] | None,
    tolerance: Array,
    max_steps: Array,
) -> tuple[Array, Array, Array, Array]:
    net, knots_u, knots_v = surface
    centre = jnp.mean(net, axis=(0, 1))
    pieces = make_pieces(net - centre[None, None, :], knots_u, knots_v)
    target = (points - centre[None, :]).T
    if start is not None:
        feet = project(method, pieces, target, *start, tolerance, max_steps)
        return feet.best_u, feet.best_v, feet.converged, feet.steps
    count = target.shape[1]
    samples = sample_points(net - centre[None, None, :], pieces.axis_u, pieces.axis_v)
    u, v = best_samples(jnp.asarray(samples[0]), jnp.asarray(samples[1]), jnp.asarray(samples[2]), target)
    twice = jnp.concatenate([target, target], axis=1)
    feet = project(method, pieces, twice, u.reshape(-1), v.reshape(-1), tolerance, max_steps)
    second = feet.squared_distance[count:] < feet.squared_distance[:count]

    def nearer(x: Array) -> Array:
        return jnp.where(second, x[count:], x[:count])

    return nearer(feet.best_u), nearer(feet.best_v), nearer(feet.converged), nearer(feet.steps)


@jax.custom_jvp
def as_feet(
    feet: tuple[Array, Array],
    surface: Arrays,
    points: Float[Array, "points d"],
    tolerance: Array,
) -> tuple[Array, Array]:
    """The parameters `feet` (u, v) of `points`, known to be feet, as functions of surface and points.

    `within` are the bounds they are confined to, if it is not the domain.
    """
    return feet


@as_feet.defjvp
def _as_feet_jvp(primals: Any, tangents: Any) -> Any:
    _, (net, knots_u, knots_v), points, tolerance = primals
    u, v = as_feet(*primals)  # for derivatives of the derivative

    def slopes(surface: Arrays, points: Array) -> tuple[Array, Array]:
        wanted = ((0, 0), (1, 0), (0, 1))
        value, along_u, along_v = evaluate_surface(*surface, u, v, wanted, False)
        e = points - value
        return jnp.sum(e * along_u, -1), jnp.sum(e * along_v, -1)

    (gu, gv), (dgu, dgv) = jax.jvp(slopes, primals[1:3], tangents[1:3])
    value, ru, rv, ruu, ruv, rvv = evaluate_surface(net, knots_u, knots_v, u, v, PARTIALS, False)
    e = points - value
    E, F, G = (jnp.sum(x * y, -1) for x, y in ((ru, ru), (ru, rv), (rv, rv)))
    a, b, c = (x - jnp.sum(e * y, -1) for x, y in ((E, ruu), (F, ruv), (G, rvv)))
    order_u, order_v = knots_u.shape[0] - net.shape[0], knots_v.shape[0] - net.shape[1]
    within = _ends(knots_u, order_u) + _ends(knots_v, order_v)
    change = foot_change((u, v), (gu, gv), (E, F, G), (a, b, c), (dgu, dgv), within, tolerance)
    return (u, v), change


def foot_change(
    feet: Any, slopes: Any, form: Any, hessian: Any, changes: Any, within: ParameterBounds, tolerance: Array
) -> tuple[Array, Array]:
    """How feet follow a change of their `slopes` (g_u, g_v) at held parameters.

    `form` are E, F, G and `hessian` its three entries; coordinates that are not free do not move.
    """
    (u, v), (gu, gv), (E, _, G) = feet, slopes, form
    low_u, high_u, low_v, high_v = within
    free_u = _free(u, gu, E, low_u, high_u, tolerance)
    free_v = _free(v, gv, G, low_v, high_v, tolerance)
    (a, b, c), (x, y) = hessian, changes
    return _solve(a, b, c, E, G, x, y, free_u, free_v)


def _ends(knots: Array, order: int) -> tuple[Array, Array]:
    return knots[order - 1], knots[-order]


def _free(u: Array, g: Array, E: Array, low: Array, high: Array, tolerance: Array) -> Array:
    """Whether a coordinate has a derivative: at no active bound, and with g = 0, unlike on a crease."""
    pushed = ((u <= low) & (g < 0)) | ((u >= high) & (g > 0)) | (low >= high)
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


def foot_moves(
    pieces: Pieces, feet: tuple[Array, Array], target: Array, jet: Jet, extent: Array
) -> tuple[Array, Array]:
    """Zero, with the derivative of the feet in local coordinates; `extent` is that of the points."""
    e = target - jet.value
    # Written out, as linear systems are solved with their derivative: XLA takes twice as long for reductions.
    slopes = reduce(add, e * jet.s), reduce(add, e * jet.t)
    form = dot(jet.s, jet.s), dot(jet.s, jet.t), dot(jet.t, jet.t)
    second = dot(e, jet.ss), dot(e, jet.st), dot(e, jet.tt)
    hessian = tuple(x - y for x, y in zip(form, second, strict=True))
    ends = tuple(x for a in (pieces.axis_u, pieces.axis_v) for x in (a.breaks[0], a.breaks[-1]))
    tolerance = FOOT_TOLERANCE * jnp.sqrt(jnp.finfo(e.dtype).eps) * extent
    return _moved(slopes, lax.stop_gradient((feet, form, hessian, ends, tolerance)))


@jax.custom_jvp
def _moved(slopes: tuple[Array, Array], fixed: Any) -> tuple[Array, Array]:
    return jnp.zeros_like(slopes[0]), jnp.zeros_like(slopes[1])


@_moved.defjvp
def _moved_jvp(primals: Any, tangents: Any) -> Any:
    slopes, (feet, form, hessian, ends, tolerance) = primals
    changes = foot_change(feet, slopes, form, hessian, tangents[0], ends, tolerance)
    return _moved(*primals), changes
