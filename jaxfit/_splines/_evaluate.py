"""Sums over control points at many parameters: the kernels behind curves and surfaces."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxfit._compile import compiled
from jaxfit._splines._basis import spans_and_weights
from jaxfit._splines._lookup import windows

# Beyond so many parameters a CPU evaluates block by block: the temporaries then stay in its cache
# (measured: three times faster at 500,000 points) and memory does not grow with the input.
LARGEST_UNBLOCKED = 8192
BLOCK = 1024


def in_blocks(kernel: Callable[..., Array], *parameters: Array) -> Array:
    """`kernel` of equally shaped parameters, flattened; results are (*shape, ...)."""
    shape = parameters[0].shape
    flat = [x.reshape(-1) for x in parameters]
    count = flat[0].size
    if count <= LARGEST_UNBLOCKED or jax.default_backend() != "cpu":
        result = kernel(*flat)
    else:
        # Padding repeats the last parameter, so that no extrapolated value can overflow.
        padded = [jnp.pad(x, (0, -count % BLOCK), mode="edge").reshape(-1, BLOCK) for x in flat]
        # Derivatives compute a block again: what they would store of all blocks is larger than the cache.
        again = jax.checkpoint(kernel)
        blocks = lax.map(lambda each: again(*each), tuple(padded))
        result = blocks.reshape(-1, *blocks.shape[2:])[:count]
    return result.reshape(*shape, *result.shape[1:])


@partial(compiled, static_argnames=("derivative", "extrapolate"))
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
        return _sum_along(control_points, knots, order, u, derivative, extrapolate)

    return in_blocks(kernel, u)


@partial(compiled, static_argnames=("wanted", "extrapolate"))
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
    nu, nv, _ = control_points.shape
    orders = knots_u.shape[0] - nu, knots_v.shape[0] - nv

    def kernel(u: Array, v: Array) -> Array:
        dus, dvs = zip(*wanted, strict=True)
        i, weights_u = spans_and_weights(knots_u, orders[0], u, dus, extrapolate)
        j, weights_v = spans_and_weights(knots_v, orders[1], v, dvs, extrapolate)
        block = _influencing_points(control_points, i, j, orders)
        # A derivative does not see the origin: moving it near keeps the digits of far points.
        near = block - block[:, :1, :1]
        weights = zip(wanted, weights_u.swapaxes(1, 2), weights_v.swapaxes(1, 2), strict=True)
        return jnp.stack(
            [_block_sum(near if du or dv else block, wu, wv, du, dv) for (du, dv), wu, wv in weights], axis=1
        )

    result = in_blocks(kernel, u, v)
    return tuple(result[..., k, :] for k in range(len(wanted)))


def _influencing_points(
    control_points: Float[Array, "nu nv d"],
    i: Int[Array, " points"],
    j: Int[Array, " points"],
    orders: tuple[int, int],
) -> Float[Array, "points K L d"]:
    """The control points that have influence on each point."""
    dimensions = lax.GatherDimensionNumbers((1, 2, 3), (), (0, 1))
    sizes = (*orders, control_points.shape[2])
    mode = lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return lax.gather(control_points, jnp.stack([i, j], axis=1), dimensions, sizes, mode=mode)


def _block_sum(
    block: Float[Array, "points K L d"],
    weights_u: Float[Array, "points K"],
    weights_v: Float[Array, "points L"],
    du: int,
    dv: int,
) -> Float[Array, "points d"]:
    # The weights of a derivative sum to zero, so the first control point may be taken from all: along
    # coincident control points (a pole) the derivative is then exactly zero.
    rows = _weighted(block - block[:, :, :1] if dv else block, weights_v, 2)
    return _weighted(rows - rows[:, :1] if du else rows, weights_u, 1)


def _weighted(
    values: Float[Array, "points *rest"], weights: Float[Array, "points order"], axis: int
) -> Array:
    """Sums along one axis of the values, by the weights of each point."""
    values = values.astype(jnp.result_type(values, weights))
    weights = weights.astype(values.dtype)
    return lax.dot_general(values, weights, (((axis,), (1,)), ((0,), (0,))), precision=lax.Precision.HIGHEST)


@partial(compiled, static_argnames=("derivatives", "extrapolate"))
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


@partial(compiled, static_argnames=("derivative", "extrapolate"))
def contract(
    control_points: Float[Array, "n m d"],
    knots: Float[Array, " knots"],
    u: Float[Array, " a"],
    derivative: int,
    extrapolate: bool,
) -> Float[Array, "a m d"]:
    """The first axis of the net evaluated at the parameters `u`."""
    order = knots.shape[0] - control_points.shape[0]
    return _sum_along(control_points, knots, order, u, derivative, extrapolate)


def _sum_along(
    control_points: Float[Array, "n *rest"],
    knots: Float[Array, " knots"],
    order: int,
    u: Float[Array, " points"],
    derivative: int,
    extrapolate: bool,
) -> Float[Array, "points *rest"]:
    """Weighted sums of the control points along the first axis."""
    first, weights = spans_and_weights(knots, order, u, (derivative,), extrapolate)
    near = jnp.moveaxis(windows(control_points, first, order), 0, 1)
    if derivative:  # see `_block_sum`
        near = near - near[:, :1]
    return _weighted(near, weights[0].T, 1)
