r"""The collocation systems of grids: tensor products, and one with a parameter pair for every point.

With parameters $u_i$ of rows and $v_j$ of columns, $\sum_{kl} N_k(u_i) N_l(v_j) P_{kl} = Q_{ij}$ falls
apart into banded systems in one direction after the other. With parameters $(u_{ij}, v_{ij})$ it is one
sparse system N P = Q; that is solved by restarted GMRES, the tensor product being the preconditioner.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._splines import _banded as banded
from jaxfit._splines._basis import spans_and_weights

Solver = Callable[[Array], Array]


class TensorCollocation(eqx.Module):
    """The bands of both directions. Nets and data are (n, m, d)."""

    band_u: Float[Array, "n band_u"]
    band_v: Float[Array, "m band_v"]

    def times(self, net: Float[Array, "n m d"]) -> Float[Array, "n m d"]:
        """The surface with this net at all parameters."""
        return banded.times(self.band_v, banded.times(self.band_u, net, axis=0), axis=1)

    def solve(self, data: Float[Array, "n m d"]) -> Float[Array, "n m d"]:
        """The net whose surface takes the values `data`."""
        return _both_ways(banded.solve, self.band_u, self.band_v, data)

    def factorised(self) -> Solver:
        """`solve` with the factors computed once, for loops; without derivatives."""
        factors = banded.factorise(self.band_u), banded.factorise(self.band_v)
        return lambda data: _both_ways(banded.substitute, *factors, data)

    def transposed(self) -> "TensorCollocation":
        """The transposed system."""
        return TensorCollocation(banded.transposed(self.band_u), banded.transposed(self.band_v))


def _both_ways(apply: Callable[[Any, Array], Array], matrix_u: Any, matrix_v: Any, x: Array) -> Array:
    n, m, d = x.shape
    x = apply(matrix_u, x.reshape(n, m * d)).reshape(n, m, d)
    x = apply(matrix_v, jnp.swapaxes(x, 0, 1).reshape(m, n * d)).reshape(m, n, d)
    return jnp.swapaxes(x, 0, 1)


def tensor_collocation(
    knots: tuple[Array, Array], order: tuple[int, int], u: Array, v: Array
) -> TensorCollocation:
    """The collocation matrices at the parameters `u` of the rows and `v` of the columns."""
    bands = [banded.collocation_band(*each) for each in zip(knots, order, (u, v), strict=True)]
    return TensorCollocation(*bands)


class PointCollocation(eqx.Module):
    """Basis functions at a parameter pair for every point: `place` is the first control point of each, as a
    row of the flattened net."""

    place: Int[Array, " points"]
    weights_u: tuple[Float[Array, " points"], ...]
    weights_v: tuple[Float[Array, " points"], ...]

    def times(self, net: Float[Array, "n m d"]) -> Float[Array, "n m d"]:
        """The surface with this net at all parameters."""
        n, m, d = net.shape
        flat, total = net.reshape(n * m, d), jnp.zeros((n * m, d), net.dtype)
        for a, weight_u in enumerate(self.weights_u):
            for b, weight_v in enumerate(self.weights_v):
                points = flat.at[self.place + (a * m + b)].get(mode="promise_in_bounds")
                total = total + (weight_u * weight_v)[:, None] * points
        return total.reshape(n, m, d)


def point_collocation(
    knots: tuple[Array, Array], order: tuple[int, int], u: Float[Array, "n m"], v: Float[Array, "n m"]
) -> PointCollocation:
    """The system at the parameters (u, v) of every point."""
    each = [
        spans_and_weights(knot, k, x.reshape(-1), (0,), False)
        for knot, k, x in zip(knots, order, (u, v), strict=True)
    ]
    (first_u, (weights_u,)), (first_v, (weights_v,)) = each
    return PointCollocation(first_u * u.shape[1] + first_v, tuple(weights_u), tuple(weights_v))


class Account(eqx.Module):
    """Errors of every net so far, as fractions of the diagonal, and the number of cycles behind the last."""

    step: Int[Array, ""]
    average: Float[Array, " steps"]
    maximum: Float[Array, " steps"]

    def noted(self, step: Array, errors: Float[Array, "n m"]) -> "Account":
        """With the errors after `step` cycles."""
        average = self.average.at[step].set(jnp.mean(errors))
        return Account(step, average, self.maximum.at[step].set(jnp.max(errors)))


def distances(residual: Float[Array, "n m d"], diagonal: Array) -> Float[Array, "n m"]:
    """Lengths of the residuals as fractions of the diagonal."""
    return jnp.sqrt(jnp.sum(residual**2, axis=-1)) / diagonal


def improved(
    system: PointCollocation,
    precondition: Solver,
    data: Float[Array, "n m d"],
    net: Float[Array, "n m d"],
    account: Account,
    limits: tuple[Array, Array, Array],
    restart: int,
) -> tuple[Array, Account]:
    """Cycles of GMRES from `net`, whose errors `account` has noted last, until the largest error is within
    the tolerance, or a cycle takes less than a tenth of it away, or `most` are done.

    `limits` are the diagonal, the tolerance and `most`. A cycle that makes the largest error greater is not
    accepted.
    """
    diagonal, tolerance, most = limits
    State = tuple[Array, Array, Account, Array]

    def goes_on(state: State) -> Array:
        _, _, account, slow = state
        return ~slow & (account.maximum[account.step] > tolerance) & (account.step < most)

    def cycle(state: State) -> State:
        net, residual, account, _ = state
        moved = net + krylov_step(system.times, precondition, residual, restart)
        rest = data - system.times(moved)
        error, before = distances(rest, diagonal), account.maximum[account.step]
        better = jnp.max(error) < before
        kept = jnp.where(better, error, distances(residual, diagonal))
        slow = ~(jnp.max(error) < 0.9 * before)
        account = account.noted(account.step + 1, kept)
        return jnp.where(better, moved, net), jnp.where(better, rest, residual), account, slow

    begin = (net, data - system.times(net), account, jnp.asarray(False))
    net, _, account, _ = lax.while_loop(goes_on, cycle, begin)
    return net, account


def krylov_step(apply: Solver, precondition: Solver, right: Array, restart: int) -> Array:
    """One cycle of GMRES from zero: the x of the Krylov space for which M (right - A x) is smallest.

    Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986; twice classical Gram-Schmidt. An exhausted space
    adds zero vectors, which the least-squares problem leaves alone.
    """
    first = precondition(right).reshape(-1)
    size = jnp.linalg.norm(first)
    least = jnp.finfo(right.dtype).tiny
    basis = jnp.zeros((restart + 1, first.shape[0]), right.dtype).at[0].set(first / jnp.maximum(size, least))
    projected = jnp.zeros((restart + 1, restart), right.dtype)

    def extend(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        basis, projected = state
        new = precondition(apply(basis[k].reshape(right.shape))).reshape(-1)
        scale = jnp.linalg.norm(new)
        shares = jnp.zeros(restart + 1, right.dtype)
        for _ in range(2):
            share = basis @ new
            new, shares = new - share @ basis, shares + share
        length = jnp.linalg.norm(new)
        fresh = length > 10 * jnp.finfo(right.dtype).eps * scale
        length = jnp.where(fresh, length, 0.0)
        basis = basis.at[k + 1].set(jnp.where(fresh, new / jnp.where(fresh, length, 1.0), 0.0))
        return basis, projected.at[:, k].set(shares.at[k + 1].set(length))

    basis, projected = lax.fori_loop(0, restart, extend, (basis, projected))
    goal = jnp.zeros(restart + 1, right.dtype).at[0].set(size)
    weights = jnp.linalg.lstsq(projected, goal)[0]
    return (weights @ basis[:-1]).reshape(right.shape)


def _krylov(apply: Solver, precondition: Solver, right: Array, restart: int) -> Array:
    """GMRES to rounding level, relative to `right`: what derivatives are solved with."""
    goal = 100 * jnp.finfo(right.dtype).eps * jnp.max(jnp.abs(right))
    State = tuple[Array, Array, Array]

    def goes_on(state: State) -> Array:
        _, residual, slow = state
        return ~slow & (jnp.max(jnp.abs(residual)) > goal)

    def cycle(state: State) -> State:
        x, residual, _ = state
        moved = x + krylov_step(apply, precondition, residual, restart)
        rest = right - apply(moved)
        before, after = jnp.max(jnp.abs(residual)), jnp.max(jnp.abs(rest))
        better = after < before
        return jnp.where(better, moved, x), jnp.where(better, rest, residual), ~(after < 0.9 * before)

    return lax.while_loop(goes_on, cycle, (jnp.zeros_like(right), right, jnp.asarray(False)))[0]


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def with_derivative(
    order: tuple[int, int],
    restart: int,
    net: Array,
    parameters: tuple[Array, Array],
    knots: tuple[Array, Array],
    tensor: TensorCollocation | None,
    data: Array,
) -> Array:
    """`net`, with the derivative of the solution of N(parameters, knots) P = data.

    That costs one solve, however the net was found; it is preconditioned by `tensor` where that is given.
    """
    return net


@with_derivative.defjvp
def _derivative(order: tuple[int, int], restart: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    _, parameters, knots, tensor, _ = primals
    _, d_parameters, d_knots, _, d_data = tangents
    net = with_derivative(order, restart, *primals)  # for derivatives of the derivative

    def values(parameters: tuple[Array, Array], knots: tuple[Array, Array]) -> Array:
        return point_collocation(knots, order, *parameters).times(net)

    _, moved = jax.jvp(values, (parameters, knots), (d_parameters, d_knots))
    system = point_collocation(knots, order, *parameters)
    there, back = _preconditioners(tensor)
    change = lax.custom_linear_solve(
        system.times,
        d_data - moved,
        solve=lambda apply, b: _krylov(apply, there, b, restart),
        transpose_solve=lambda apply, b: _krylov(apply, back, b, restart),
    )
    return net, change


def _preconditioners(tensor: TensorCollocation | None) -> tuple[Solver, Solver]:
    """For the system and its transpose."""
    if tensor is None:
        return lambda x: x, lambda x: x
    tensor = lax.stop_gradient(tensor)
    return tensor.factorised(), tensor.transposed().factorised()
