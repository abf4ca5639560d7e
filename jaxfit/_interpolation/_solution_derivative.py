"""The derivative of a net that solves N(u, v, knots) P = Q, however it was found: one linear solve."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxfit._fit._history import ErrorHistory
from jaxfit._interpolation._gmres import GmresLimits, append_errors, distances, gmres_solve
from jaxfit._interpolation._per_point_collocation import PointCollocation, point_collocation
from jaxfit._interpolation._tensor_collocation import TensorCollocation
from jaxfit._normal_equations import Operator
from jaxfit._splines._pieces import Axis


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def with_derivative(
    restart: int,
    net: Array,
    parameters: tuple[Array, Array],
    axes: tuple[Axis, Axis],
    tensor: TensorCollocation | None,
    data: Array,
) -> Array:
    r"""`net` (n, m, d), with the derivative $N \, dP = dQ - dN \, P$.

    That is solved by GMRES, preconditioned by `tensor` where that is given.
    """
    return net


@with_derivative.defjvp
def _derivative(restart: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    _, parameters, axes, tensor, _ = primals
    _, d_parameters, d_axes, _, d_data = tangents
    net = with_derivative(restart, *primals)  # for derivatives of the derivative

    def matrix(parameters: tuple[Array, Array], axes: tuple[Axis, Axis]) -> PointCollocation:
        return point_collocation(axes, *parameters)

    system, d_system = jax.jvp(matrix, (parameters, axes), (d_parameters, d_axes))
    _, moved = jax.jvp(lambda system: times_last(system, net), (system,), (d_system,))
    there, back = _preconditioners(tensor)
    change = lax.custom_linear_solve(
        lambda x: times_last(system, x),
        d_data - moved,
        solve=lambda apply, b: _to_rounding(apply, there, b, restart),
        transpose_solve=lambda apply, b: _to_rounding(apply, back, b, restart),
    )
    return net, change


def times_last(system: PointCollocation, net: Array) -> Array:
    """N P of nets (n, m, d)."""
    return jnp.moveaxis(system.times(jnp.moveaxis(net, -1, 0)), 0, -1)


def _to_rounding(apply: Operator, precondition: Operator, right: Array, restart: int) -> Array:
    one = jnp.ones((), right.dtype)
    errors = distances(right, one)
    tolerance = 100 * jnp.finfo(right.dtype).eps * jnp.max(errors)
    limits = GmresLimits(one, tolerance, jnp.asarray(jnp.iinfo(jnp.int32).max))
    zero, nothing = jnp.zeros((), jnp.int32), jnp.zeros_like(right)
    empty = ErrorHistory(jnp.zeros((4, 1), right.dtype), jnp.zeros((3, 1), jnp.int32), one)
    history = append_errors(empty, zero, errors)
    return gmres_solve(apply, precondition, right, nothing, zero, history, limits, restart)[0]


def _preconditioners(tensor: TensorCollocation | None) -> tuple[Operator, Operator]:
    """For the system and its transpose."""
    if tensor is None:
        return lambda x: x, lambda x: x
    tensor = lax.stop_gradient(tensor)
    return tensor.factorised(), tensor.transposed().factorised()
