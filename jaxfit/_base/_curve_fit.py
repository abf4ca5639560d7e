"""Geometric approximation of polylines by B-spline curves (Algorithm 1 in its curve form)."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfit._compile import compiled
from jaxfit._splines._basis import spans_and_weights
from jaxfit._splines._insertion import insert_along

CHECK_EVERY = 8  # steps between two checks that the error still falls


class CurveStart(NamedTuple):
    """A curve to fit, as NumPy arrays: what it should pass, and where it starts.

    `points` (points, d) with their starting parameters `feet` (points,); `control` (n, d), of
    which the two ends stay; `knots` (n + order,), from 0 to 1; `new_knots` (m,) to insert
    after the fit.
    """

    points: np.ndarray
    feet: np.ndarray
    control: np.ndarray
    knots: np.ndarray
    new_knots: np.ndarray


class _Problem(NamedTuple):
    points: Array
    weights: Array
    knots: Array
    free: Array  # (capacity, 1), 1 where the control point may move
    new_knots: Array  # (capacity,)


class _Feet(NamedTuple):
    u: Array  # (points,)
    touched: Array  # (points, order), the control points of each foot
    basis: Array  # (points, order)
    errors: Array  # (points, d)


class _State(NamedTuple):
    control: Array
    feet: Array
    reference: Array  # average error at the last check
    step: Array
    done: Array


def fit_curves(
    starts: Sequence[CurveStart], order: int, tolerance: float, max_steps: int, dtype: np.dtype
) -> list[tuple[np.ndarray, np.ndarray]]:
    r"""Control points and knots of several curves, fitted and refined in one compiled call.

    Each step projects the points onto the curve and moves every control point but the ends by

    $$P_i \mathrel{+}= \sum_k N_i(u_k) e_k / \sum_k N_i(u_k), \qquad e_k = Q_k - C(u_k)$$

    (paper section 4.1, Algorithm 1, for curves). A control point that no point touches stays.
    A curve is finished when its average error is below `tolerance`, falls by less than 1 % in 8
    steps, or after `max_steps`. Coordinates should be centred and of size 1.

    Everything is padded to powers of two (points with weight 0, control points behind repeated
    end knots), so that curves of similar size compile nothing new.
    """
    points = _power_of_two(max(len(s.points) for s in starts), 256)
    capacity = _power_of_two(max(max(len(s.control), len(s.new_knots)) for s in starts), 64)
    padded = [_padded(s, points, capacity) for s in starts]
    arrays = [jnp.asarray(np.stack(x).astype(dtype)) for x in zip(*padded, strict=True)]
    problem, feet, control = _Problem(*arrays[:5]), arrays[5], arrays[6]
    limit = jnp.asarray(np.asarray(tolerance, dtype))
    refined = _fit_batch(order, problem, feet, control, limit, np.int32(max_steps))
    sizes = [len(s.control) + len(s.new_knots) for s in starts]
    controls, knots = (np.asarray(x) for x in refined)
    return [(c[:n], t[: n + order]) for c, t, n in zip(controls, knots, sizes, strict=True)]


def _power_of_two(count: int, least: int) -> int:
    return max(least, 1 << (count - 1).bit_length())


def _padded(start: CurveStart, points: int, capacity: int) -> tuple[np.ndarray, ...]:
    spare, count = points - len(start.points), len(start.control)
    weights = np.concatenate([np.ones(len(start.points)), np.zeros(spare)])
    free = np.zeros((capacity, 1))
    free[1 : count - 1] = 1.0
    return (
        np.pad(start.points, [(0, spare), (0, 0)], mode="edge"),
        weights,
        np.pad(start.knots, (0, capacity - count), mode="edge"),
        free,
        np.pad(start.new_knots, (0, capacity - len(start.new_knots)), constant_values=1.0),
        np.pad(start.feet, (0, spare), mode="edge"),
        np.pad(start.control, [(0, capacity - count), (0, 0)], mode="edge"),
    )


@partial(compiled, kept=True, static_argnums=0)
def _fit_batch(
    order: int, problem: _Problem, feet: Array, control: Array, tolerance: Array, max_steps: Array
) -> tuple[Array, Array]:
    def fit(problem: _Problem, feet: Array, control: Array) -> tuple[Array, Array]:
        infinite = jnp.asarray(jnp.inf, control.dtype)
        start = _State(control, feet, infinite, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
        end = jax.lax.while_loop(
            lambda state: ~state.done & (state.step < max_steps),
            lambda state: _step(problem, state, tolerance, order),
            start,
        )
        return insert_along(end.control, problem.knots, problem.new_knots)

    return jax.vmap(fit)(problem, feet, control)


def _step(problem: _Problem, state: _State, tolerance: Array, order: int) -> _State:
    foot = _projected(problem, state.control, state.feet, order)
    moments = jnp.concatenate([foot.errors, jnp.ones_like(foot.errors[:, :1])], axis=-1)
    terms = (problem.weights[:, None] * foot.basis)[..., None] * moments[:, None, :]
    sums = jnp.zeros((len(problem.free), moments.shape[-1]), terms.dtype)
    sums = sums.at[foot.touched].add(terms)
    den = sums[:, -1:]
    moves = sums[:, :-1] / jnp.where(den > 0, den, 1)  # zero where no point touches
    average = jnp.sum(problem.weights * _lengths(foot.errors)) / jnp.sum(problem.weights)
    check = (state.step % CHECK_EVERY) == CHECK_EVERY - 1
    return _State(
        state.control + problem.free * moves,
        foot.u,
        jnp.where(check, average, state.reference),
        state.step + 1,
        (average <= tolerance) | (check & (average > 0.99 * state.reference)),
    )


def _projected(problem: _Problem, control: Array, feet: Array, order: int) -> _Feet:
    """One Newton step of every foot towards the nearest point; kept only where it comes closer.

    Warm starts and short steps keep a foot on its own branch where the curve turns back.
    """
    here, (first, second) = _located(problem, control, feet, order, (1, 2))
    slope = jnp.sum(first * first, axis=-1)
    second_derivative = slope - jnp.sum(here.errors * second, axis=-1)
    # Far off the curve the second-order term may reverse the step: Gauss-Newton instead.
    curved = second_derivative > 0.1 * slope
    scale = jnp.where(curved, second_derivative, slope)
    step = jnp.sum(here.errors * first, axis=-1) / jnp.where(scale > 0, scale, 1)
    start, stop = problem.knots[0], problem.knots[-1]
    reach = (stop - start) / 16
    moved = jnp.clip(feet + jnp.clip(step, -reach, reach), start, stop)
    there, _ = _located(problem, control, moved, order, ())
    closer = _lengths(there.errors) < _lengths(here.errors)

    def choose(x: Array, y: Array) -> Array:
        return jnp.where(closer.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(choose, there, here)


def _located(
    problem: _Problem, control: Array, u: Array, order: int, derivatives: tuple[int, ...]
) -> tuple[_Feet, list[Array]]:
    first, weights = spans_and_weights(problem.knots, order, u, (0, *derivatives), False)
    touched = first[:, None] + jnp.arange(order)[None, :]
    basis = weights.swapaxes(1, 2)
    # Sums, not matrix products, which accelerators may round to fewer digits.
    values = [jnp.sum(b[..., None] * control[touched], axis=1) for b in basis]
    return _Feet(u, touched, basis[0], problem.points - values[0]), values[1:]


def _lengths(x: Array) -> Array:
    return jnp.sqrt(jnp.sum(x * x, axis=-1))
