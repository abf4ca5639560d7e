"""Sums over control points at many parameters: the kernels behind curves and surfaces."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxfit._splines._basis import spans_and_weights

# Beyond WHOLE parameters a CPU evaluates block by block: the temporaries then stay in its cache
# (measured: three times faster at 500,000 points) and memory does not grow with the input.
WHOLE = 8192
BLOCK = 4096


def in_blocks(kernel: Callable[..., Array], *parameters: Array) -> Array:
    """`kernel` of equally shaped parameters, flattened; results are (*shape, ...)."""
    shape = parameters[0].shape
    flat = [x.reshape(-1) for x in parameters]
    count = flat[0].size
    if count <= WHOLE or jax.default_backend() != "cpu":
        result = kernel(*flat)
    else:
        # Padding repeats the last parameter, so that no extrapolated value can overflow.
        padded = [jnp.pad(x, (0, -count % BLOCK), mode="edge").reshape(-1, BLOCK) for x in flat]
        blocks = lax.map(lambda each: kernel(*each), tuple(padded))
        result = blocks.reshape(-1, *blocks.shape[2:])[:count]
    return result.reshape(*shape, *result.shape[1:])


@partial(jax.jit, static_argnames=("derivative", "extrapolate"))
def evaluate_curve(
    control_points: Float[Array, "n d"],
    knots: Float[Array, " knots"],
    u: Float[Array, "*shape"],
    derivative: int,
    extrapolate: bool,
) -> Float[Array, "*shape d"]:
    """One derivative of a curve at every parameter."""
    order = knots.shape[0] - control_points.shape[0]

    def kernel(u: Array) -> Array:
        first, (weights,) = spans_and_weights(knots, order, u, (derivative,), extrapolate)
        points = [_at(control_points, first + r) for r in range(order)]
        return _combined(points, weights, derivative)

    return in_blocks(kernel, u)


@partial(jax.jit, static_argnames=("wanted", "extrapolate"))
def evaluate_surface(
    control_points: Float[Array, "nu nv d"],
    knots_u: Float[Array, " knots_u"],
    knots_v: Float[Array, " knots_v"],
    u: Float[Array, "*shape"],
    v: Float[Array, "*shape"],
    wanted: tuple[tuple[int, int], ...],
    extrapolate: bool,
) -> tuple[Float[Array, "*shape d"], ...]:
    """The wanted partial derivatives (du, dv) of a surface at every pair of parameters."""
    nu, nv, d = control_points.shape
    orders = knots_u.shape[0] - nu, knots_v.shape[0] - nv
    flat = control_points.reshape(nu * nv, d)
    sums = _one_sum if len(wanted) == 1 else _many_sums

    def kernel(u: Array, v: Array) -> Array:
        dus, dvs = zip(*wanted, strict=True)
        i, weights_u = spans_and_weights(knots_u, orders[0], u, dus, extrapolate)
        j, weights_v = spans_and_weights(knots_v, orders[1], v, dvs, extrapolate)
        return sums(flat, nv, i * nv + j, weights_u, weights_v, wanted)

    result = in_blocks(kernel, u, v)
    return tuple(result[..., k, :] for k in range(len(wanted)))


def _at(flat: Array, index: Array) -> Array:
    return flat.at[index].get(mode="promise_in_bounds")


def _combined(points: list[Array], weights: list[Array], derivative: int) -> Array:
    """The weighted sum of points (..., d) by weights (...)."""
    if derivative:
        # These weights sum to zero, so the first point may be taken from all: the derivative
        # along a row of coincident control points (a pole) is then exactly zero.
        points, weights = [point - points[0] for point in points[1:]], weights[1:]
    total = jnp.zeros_like(points[0])
    for point, weight in zip(points, weights, strict=True):
        total = total + point * weight.reshape(*weight.shape, *(1,) * (point.ndim - weight.ndim))
    return total


def _one_sum(flat: Array, nv: int, corner: Array, weights_u: list, weights_v: list, wanted: tuple) -> Array:
    # One gather per control point fuses into the sum: nothing of size K L d is ever stored.
    ((du, dv),) = wanted
    # A derivative does not see the origin: moving it near keeps the digits of far points.
    origin = _at(flat, corner) if du or dv else 0.0
    rows = []
    for a in range(len(weights_u[0])):
        row = [_at(flat, corner + a * nv + b) - origin for b in range(len(weights_v[0]))]
        rows.append(_combined(row, weights_v[0], dv))
    return _combined(rows, weights_u[0], du)[:, None, :]


def _many_sums(flat: Array, nv: int, corner: Array, weights_u: list, weights_v: list, wanted: tuple) -> Array:
    # Several derivatives share one gathered block (points, K, L, d) instead.
    steps = jnp.arange(len(weights_u[0]))[:, None] * nv + jnp.arange(len(weights_v[0]))[None, :]
    block = _at(flat, corner[:, None, None] + steps[None])
    near = block - block[:, :1, :1]
    sides = near - near[:, :, :1]
    results = []
    for (du, dv), wu, wv in zip(wanted, weights_u, weights_v, strict=True):
        rows = _product("nabd,nb->nad", sides if dv else near if du else block, wv)
        results.append(_product("nad,na->nd", rows - rows[:, :1] if du else rows, wu))
    return jnp.stack(results, axis=1)


def _product(pattern: str, values: Array, weights: list[Array]) -> Array:
    stacked = jnp.stack(weights, axis=-1)
    return jnp.einsum(pattern, values, stacked, precision=lax.Precision.HIGHEST)


@partial(jax.jit, static_argnames=("derivatives", "extrapolate"))
def evaluate_grid(
    control_points: Float[Array, "nu nv d"],
    knots_u: Float[Array, " knots_u"],
    knots_v: Float[Array, " knots_v"],
    us: Float[Array, " a"],
    vs: Float[Array, " b"],
    derivatives: tuple[int, int],
    extrapolate: bool,
) -> Float[Array, "a b d"]:
    """One partial derivative on a grid of parameters, one direction after the other."""
    if any(derivatives):
        control_points = control_points - control_points[:1, :1]
    rows = contract(control_points, knots_u, us, derivatives[0], extrapolate)
    columns = contract(jnp.swapaxes(rows, 0, 1), knots_v, vs, derivatives[1], extrapolate)
    return jnp.swapaxes(columns, 0, 1)


@partial(jax.jit, static_argnames=("derivative", "extrapolate"))
def contract(
    control_points: Float[Array, "n m d"],
    knots: Float[Array, " knots"],
    u: Float[Array, " a"],
    derivative: int,
    extrapolate: bool,
) -> Float[Array, "a m d"]:
    """The first axis of the net evaluated at the parameters `u`."""
    order = knots.shape[0] - control_points.shape[0]
    first, (weights,) = spans_and_weights(knots, order, u, (derivative,), extrapolate)
    return _combined([_at(control_points, first + r) for r in range(order)], weights, derivative)
