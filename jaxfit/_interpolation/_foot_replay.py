r"""The derivative of geometric interpolation in its data: the moves of the feet replayed, linearised.

The fit satisfies $N(\hat u, \hat v) P = Q$. Its derivative needs the derivative of the feet in the data. The
feet moved in the first few iterations only, and these are replayed. At a foot
$g = (e \cdot R_u, e \cdot R_v) = 0$, so that $d(u, v) = H^{-1} dg$, $dg$ being taken at held parameters; the
error vectors then change by $de = dQ - dR - R_u du - R_v dv$, and the net by $d(w e)$.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxfit._closest import ParameterBounds
from jaxfit._closest._implicit import foot_change
from jaxfit._compile import compiled
from jaxfit._differentiable_once import differentiated
from jaxfit._fit._border import corners
from jaxfit._fit._feet import side_bounds
from jaxfit._interpolation._per_point_collocation import PointCollocation, at_cells, control_point_windows
from jaxfit._interpolation._solution_derivative import with_derivative
from jaxfit._interpolation._step_weights import lowest_eigenvalue
from jaxfit._splines._pieces import Axis, make_axis

NOISE = 1e3  # rounding units of the diagonal: the error of a point so close counts as 0
SHORT = 8  # moves: up to so many are stored rather than computed twice
RESTART = 20  # of GMRES; the system is well conditioned wherever the iteration converges

Pair = tuple[Any, Any]


class FitInputs(eqx.Module):
    """The inputs of a fit, in the problem's unit."""

    data: Float[Any, "nu nv d"]
    knots: Pair
    averaged: Pair
    feet: Pair  # to start from, (nu, nv) each
    diagonal: Float[Any, ""]
    tolerance: Float[Any, ""]
    foot_tolerance: Float[Any, ""]


class Fitted(eqx.Module):
    """The net and the feet of a finished fit."""

    net: Float[Array, "nu nv d"]
    u: Float[Array, "nu nv"]
    v: Float[Array, "nu nv"]


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def attach_derivative(
    method: Any,
    order: tuple[int, int],
    fitted: Fitted,
    path: Float[Array, "moves 2 points"],
    inputs: FitInputs,
) -> Fitted:
    """`fitted`, with the derivative in `inputs` that the method's adjoint asks for.

    `path` holds the feet before each of the first moves, or nothing where they have no derivative.
    """
    return fitted


@attach_derivative.defjvp
def _attach_jvp(method: Any, order: tuple[int, int], primals: Any, tangents: Any) -> Any:
    fitted, path, inputs = primals
    inputs = differentiated(inputs) if path.shape[0] else inputs  # held feet have every derivative
    fitted = attach_derivative(method, order, fitted, path, inputs)  # for derivatives of the derivative
    return jax.jvp(partial(_replayed, method, order, fitted, path), (inputs,), tangents[2:])


@partial(compiled, kept=True, static_argnums=(0, 1))
def _replayed(method: Any, order: tuple[int, int], fitted: Fitted, path: Array, inputs: FitInputs) -> Fitted:
    """`fitted` as a function of what the fit started from."""
    u, v, knots = fitted.u, fitted.v, inputs.knots
    knots = knots if path.shape[0] else lax.stop_gradient(knots)
    axes = make_axis(knots[0], order[0], simple=True), make_axis(knots[1], order[1], simple=True)
    if path.shape[0]:
        feet = _feet_along(lax.stop_gradient(path), method, axes, inputs)
        # The values are those of the fit, which may have searched its feet again at the end.
        u, v = (x + (y - lax.stop_gradient(y)) for x, y in zip((u, v), feet, strict=True))
    net = with_derivative(RESTART, fitted.net, (u, v), axes, None, inputs.data)
    return Fitted(net, u, v)


def _feet_along(path: Array, method: Any, axes: tuple[Axis, Axis], inputs: FitInputs) -> Pair:
    """The last feet of the path, as a differentiable function of axes and inputs."""
    replay = FootReplay.of(method, axes, inputs)

    def step(before: tuple[Array, Pair], feet: Array) -> tuple[tuple[Array, Pair], None]:
        return replay.step(before, feet), None

    begin = (replay.data, jax.tree.map(jnp.asarray, inputs.feet))
    path = path.reshape(*path.shape[:2], *inputs.data.shape[:2])
    return lax.scan(jax.checkpoint(step) if len(path) > SHORT else step, begin, path)[0][1]


class SpanTable(eqx.Module):
    """The basis functions of all spans in one direction, as functions that can be differentiated."""

    polynomials: Float[Array, "power K cells"]
    centre: Float[Array, " cells"]
    half: Float[Array, " cells"]

    def derivatives(self, cell: Int[Array, "nu nv"], u: Float[Array, "nu nv"]) -> Float[Array, "3 K nu nv"]:
        """Values, first and second derivatives of the K functions that do not vanish, by Horner's rule."""
        rate = 1.0 / at_cells(self.half, cell)
        s = ((u - at_cells(self.centre, cell)) * rate)[None, None]
        power = at_cells(self.polynomials, cell)[:, None]
        zero = jnp.zeros_like(power[0])
        value = jnp.concatenate([power[-1], zero, zero])
        for k in reversed(range(len(power) - 1)):
            value = value * s + jnp.concatenate([power[k], value[:-1]])
        return value * jnp.stack([jnp.ones_like(rate), rate, 2.0 * rate**2])[:, None]


class FootReplay(eqx.Module):
    """The iteration while feet move. Nets and data have their coordinates first."""

    method: Any = eqx.field(static=True)
    axes: tuple[Axis, Axis]
    tables: tuple[SpanTable, SpanTable]
    data: Float[Array, "d nu nv"]
    within: ParameterBounds | None
    diagonal: Array
    tolerance: Array
    foot_tolerance: Array
    lowest: Array

    @staticmethod
    def of(method: Any, axes: tuple[Axis, Axis], inputs: FitInputs) -> "FootReplay":
        """That of a fit."""
        tables = [SpanTable(*map(jnp.asarray, (x.polynomials.T, x.centre, x.half))) for x in axes]
        data = jnp.moveaxis(jnp.asarray(inputs.data), -1, 0)
        within = side_bounds(axes, *data.shape[1:]) if method.keep_borders else None
        lowest = jnp.ones((), data.dtype)
        if method.needs_spectrum:
            lowest = lowest_eigenvalue(axes, inputs.averaged)
        limits = inputs.diagonal, inputs.tolerance * inputs.diagonal, inputs.foot_tolerance * inputs.diagonal
        return FootReplay(method, axes, (tables[0], tables[1]), data, within, *limits, lowest)

    @property
    def held(self) -> Any:
        """The corners, which never move."""
        return corners(*self.data.shape[1:])

    def step(self, before: tuple[Array, Pair], path: Float[Array, "2 nu nv"]) -> tuple[Array, Pair]:
        """One move of the net, the values of its feet being known; feet that are not stay where they are."""
        net, method = before[0], self.method
        feet = tuple(jnp.where(jnp.isnan(x), y, x) for x, y in zip(path, before[1], strict=True))
        feet = lax.stop_gradient(feet)
        cells = tuple(axis.locate(x) for axis, x in zip(self.axes, feet, strict=True))
        u, v, e, *basis = at_feet(self, cells, feet, jnp.isnan(path[0]), *before)
        weight = method.repositioning.weights(PointCollocation(*cells, *basis), self.lowest)
        still = self.held
        if method.local:
            still = still | (jnp.sum(e**2, axis=0) <= self.tolerance**2)
        shift = jnp.where(still[None], 0.0, weight[None] * e)
        move, _ = method.acceleration.step(shift, method.acceleration.init(shift, weight, self.lowest))
        return net + move, (u, v)

    def partials(self, net: Array, cells: Pair, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """All derivatives of R up to the second in either parameter, (3, 3, d, nu, nv), and those of the
        basis functions."""
        along_u, along_v = (
            table.derivatives(cell, x) for table, cell, x in zip(self.tables, cells, (u, v), strict=True)
        )
        windows = control_point_windows(net, *cells, len(along_u[0]), len(along_v[0]))
        rows = jnp.sum(windows[None] * along_v[:, None, None], axis=3)
        return jnp.sum(rows[None] * along_u[:, None, None], axis=3), along_u, along_v


def _values_at(
    replay: FootReplay, cells: Pair, feet: Pair, unknown: Array, net: Array, before: Pair
) -> tuple[Array, ...]:
    partials, along_u, along_v = replay.partials(net, cells, *feet)
    return *feet, replay.data - partials[0, 0], along_u[0], along_v[0]


# Parameters u and v, error vectors, and the values of the basis functions, all at feet that are known.
at_feet = jax.custom_jvp(_values_at)


@jax.custom_jvp
def _parameters_at(
    replay: FootReplay, cells: Pair, feet: Pair, unknown: Array, net: Array, before: Pair
) -> Pair:
    return feet


@_parameters_at.defjvp
def _parameters_jvp(primals: Any, tangents: Any) -> Any:
    values, changes = _linearised(primals, tangents)
    return values[:2], changes[:2]


@at_feet.defjvp
def _linearised(primals: Any, tangents: Any) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """What `at_feet` gives, and how it follows net, data and knots."""
    replay, cells, _, unknown, net, _ = primals
    d_replay, _, _, _, d_net, d_before = tangents
    u, v = _parameters_at(*primals)  # for derivatives of the derivative

    def partials(tables: Any, net: Array) -> tuple[Array, Array, Array]:
        there = eqx.tree_at(lambda x: x.tables, replay, tables)
        return there.partials(net, cells, u, v)

    (r, along_u, along_v), (dr, d_along_u, d_along_v) = jax.jvp(
        partials, (replay.tables, net), (d_replay.tables, d_net)
    )
    e = replay.data - r[0, 0]
    de = d_replay.data - dr[0, 0]
    first = jnp.stack([r[1, 0], r[0, 1]])
    second = jnp.stack([r[2, 0], r[1, 1], r[0, 2]])
    slopes = jnp.sum(e[None] * first, axis=1)
    changes = jnp.sum(de[None] * first + e[None] * jnp.stack([dr[1, 0], dr[0, 1]]), axis=1)
    form = jnp.sum(jnp.stack([r[1, 0], r[1, 0], r[0, 1]]) * jnp.stack([r[1, 0], r[0, 1], r[0, 1]]), axis=1)
    hessian = form - jnp.sum(e[None] * second, axis=1)
    within = (
        _domain(replay.axes) if replay.within is None else tuple(x.reshape(u.shape) for x in replay.within)
    )
    du, dv = foot_change((u, v), slopes, form, hessian, changes, within, replay.foot_tolerance)
    # Where a point is met to rounding, its foot follows that before: which way it would move is noise.
    noise = NOISE * jnp.finfo(net.dtype).eps * replay.diagonal
    still = replay.held | unknown | (jnp.sum(e**2, axis=0) <= noise**2)
    du, dv = (jnp.where(still, old, new) for old, new in zip(d_before, (du, dv), strict=True))
    de = de - r[1, 0] * du[None] - r[0, 1] * dv[None]
    d_basis_u = d_along_u[0] + along_u[1] * du[None]
    d_basis_v = d_along_v[0] + along_v[1] * dv[None]
    return (u, v, e, along_u[0], along_v[0]), (du, dv, de, d_basis_u, d_basis_v)


def _domain(axes: tuple[Axis, Axis]) -> ParameterBounds:
    (low_u, high_u), (low_v, high_v) = ((x.breaks[0], x.breaks[-1]) for x in axes)
    return low_u, high_u, low_v, high_v
