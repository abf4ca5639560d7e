"""Solving the collocation system of a grid with a parameter pair for every point, and correcting these."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._closest import Newton, project
from jaxfit._fit._measure import FOOT_STEPS
from jaxfit._interpolation._collocation_systems import (
    Account,
    TensorCollocation,
    distances,
    improved,
    point_collocation,
)
from jaxfit._splines._pieces import make_pieces


class Task(eqx.Module):
    """The data, and what all solves share."""

    data: Float[Array, "n m d"]
    knots: tuple[Array, Array]
    tensor: TensorCollocation
    limits: tuple[Array, Array, Array]  # diagonal, tolerance, most cycles


class Corrected(eqx.Module):
    """Everything that goes round the loop of corrections."""

    net: Array
    u: Array
    v: Array
    account: Account
    number: Array  # of corrections
    change: Array
    lost: Array
    slow: Array


def new_account(room: int, errors: Array) -> Account:
    empty = jnp.full(room, jnp.nan, errors.dtype)
    zero = jnp.asarray(0, jnp.int32)
    return Account(zero, empty, empty).noted(zero, errors)


def errors_at(order: tuple[int, int], task: Task, net: Array, u: Array, v: Array) -> Array:
    """Distances at the parameters."""
    return distances(task.data - point_collocation(task.knots, order, u, v).times(net), task.limits[0])


def settled(
    method: Any,
    order: tuple[int, int],
    task: Task,
    net: Array,
    u: Array,
    v: Array,
    account: Account,
) -> Corrected:
    """The system at these parameters, solved as well as it can be."""
    system = point_collocation(task.knots, order, u, v)
    net, account = improved(
        system, task.tensor.factorised(), task.data, net, account, task.limits, method.restart
    )
    zero = jnp.asarray(0, jnp.int32)
    far = jnp.asarray(jnp.inf, net.dtype)
    return Corrected(net, u, v, account, zero, far, zero, jnp.asarray(False))


def corrected(method: Any, order: tuple[int, int], task: Task, found: Corrected) -> Corrected:
    """Closest points and a new solve in turn, until the parameters rest, or neither they nor the errors
    come down any more."""
    n, m, d = task.data.shape
    diagonal, _, most = task.limits
    target = task.data.reshape(n * m, d).T
    still = 100 * float(jnp.finfo(target.dtype).eps)

    def goes_on(now: Corrected) -> Array:
        left = (now.number < method.max_corrections) & (now.account.step < most)
        return left & (now.change > still) & ~now.slow

    def correct(now: Corrected) -> Corrected:
        pieces = make_pieces(now.net, *task.knots)
        feet = project(
            Newton(),
            pieces,
            target,
            now.u.reshape(-1),
            now.v.reshape(-1),
            method.foot_tolerance * diagonal,
            jnp.asarray(FOOT_STEPS, jnp.int32),
        )
        u, v = feet.best_u.reshape(n, m), feet.best_v.reshape(n, m)
        change = jnp.maximum(jnp.max(jnp.abs(u - now.u)), jnp.max(jnp.abs(v - now.v)))
        account = now.account.noted(now.account.step, errors_at(order, task, now.net, u, v))
        new = settled(method, order, task, now.net, u, v, account)
        step, before = new.account.step, now.account.maximum[now.account.step]
        slow = (change > 0.9 * now.change) & (new.account.maximum[step] > 0.9 * before)
        lost = jnp.sum(~feet.converged, dtype=jnp.int32)
        return Corrected(new.net, u, v, new.account, now.number + 1, change, lost, slow)

    return lax.while_loop(goes_on, correct, found)
