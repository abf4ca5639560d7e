"""Standard interpolation of grids: the collocation system of sections 2.2 and 3 of the paper."""

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxfit._checks import check_kind, check_number
from jaxfit._fit._problem import axes_of_averages
from jaxfit._interpolation._gmres import ErrorHistory, Limits, distances
from jaxfit._interpolation._outcome import extent_of
from jaxfit._interpolation._parameter_correction import CollocationProblem, Corrected, corrected, solved_at
from jaxfit._interpolation._solution_derivative import with_derivative
from jaxfit._interpolation._tensor_collocation import tensor_collocation
from jaxfit._parameters import AbstractParametrisation, ChordLength, grid_parameters
from jaxfit._splines import averaging_knots

Pair = tuple[Array, Array]


class StandardInterpolation(eqx.Module):
    r"""Solve the linear system $\sum_{kl} N_k(u_{ij}) N_l(v_{ij}) P_{kl} = Q_{ij}$ for the control points.

    By default all points of a row share $u_i$ and all points of a column share $v_j$, the averages
    of the rows' and columns' own parameters. The system is then a tensor product and takes two passes of
    banded elimination, $O(nm(K + L))$ in all; the errors are at rounding level.

    Parameters
    ----------
    parametrisation : ChordLength() or Centripetal()
        Of the grid's rows and columns; its averages give the knots (5).
    per_point : bool, default False
        Whether every point keeps the parameters $(u_{ij}, v_{ij})$ it has in its own row and column. The
        sparse system is solved by GMRES, preconditioned by the tensor product.
    parameter_correction : bool, default False
        Whether to replace the parameters by those of the closest points and to solve again, until they no
        longer move or, where they do not settle, the errors stop falling.
    max_corrections : int, default 10
        Most corrections.
    foot_tolerance : float, default 1e-13
        To what tangential error closest points are found, as a fraction of the diagonal.
    restart : int, default 20
        Iterations in a cycle of GMRES; it needs memory for as many nets.

    Notes
    -----
    The tensor product always has a solution (Schoenberg-Whitney), with derivatives of any order in the
    data: parameters and knots follow the data. Where neighbours are very unevenly spaced the
    control points, and with them the rounding errors, grow with the order; `Centripetal()` or a lower order
    helps.

    The knots suit the averages. Where rows differ from these by about the distance of two neighbours, the
    system of `per_point` is nearly singular or has no solution; the fit then ends as stalled, on the best
    surface found.

    A surface that passes through its data at its parameters needs no correction: the points are their own
    closest points. Correction matters where the system of `per_point` could not be solved. Derivatives
    leave out how corrections move.

    In `Fit.stats`, `num_steps` counts cycles of GMRES (0 for the tensor product alone), `corrections` the
    corrections, and `parameter_change` is the greatest change of a parameter in the last one. `errors`
    carry no derivative.

    Source: section 2.2 of Kineri, Wang, Lin and Maekawa (2012); C. de Boor, A Practical Guide to Splines,
    chapter XIII, for the banded elimination.
    """

    parametrisation: AbstractParametrisation = ChordLength()
    per_point: bool = False
    parameter_correction: bool = False
    max_corrections: int = 10
    foot_tolerance: float = 1e-13
    restart: int = 20

    def __check_init__(self) -> None:
        check_kind("parametrisation", self.parametrisation, AbstractParametrisation, "ChordLength()")
        check_number("max_corrections", self.max_corrections, 0, whole=True)
        check_number("foot_tolerance", self.foot_tolerance, 0.0)
        check_number("restart", self.restart, 1, whole=True)

    @property
    def iterative(self) -> bool:
        """Whether more than the tensor product is to be solved."""
        return self.per_point or self.parameter_correction


class Solution(eqx.Module):
    """What the traced part returns; lengths in the problem's unit, errors as fractions of the diagonal."""

    net: Float[Array, "n m d"]
    knots: Pair
    u: Float[Array, "n m"]
    v: Float[Array, "n m"]
    errors: Float[Array, "n m"]
    history: ErrorHistory
    extent: Float[Array, "2"]
    corrections: Array
    parameter_change: Array
    lost: Array  # closest points not found to the tolerance


def solved(
    method: StandardInterpolation,
    order: tuple[int, int],
    room: int,
    data: Float[Array, "n m d"],
    limits: Limits,
) -> Solution:
    """The whole fit; `room` is the length of the history."""
    n, m, _ = data.shape
    parameters = grid_parameters(data, method.parametrisation)
    averaged = parameters.u, parameters.v
    knots = averaging_knots(averaged[0], order[0]), averaging_knots(averaged[1], order[1])
    tensor = tensor_collocation(knots, order, *averaged)
    net = tensor.solve(data)
    if method.per_point:
        u, v = parameters.rows_u, parameters.rows_v
    else:
        u = jnp.broadcast_to(averaged[0][:, None], (n, m))
        v = jnp.broadcast_to(averaged[1][None, :], (n, m))
    zero, rest = jnp.zeros((), jnp.int32), jnp.zeros((), data.dtype)
    if method.iterative:
        problem = CollocationProblem(data, axes_of_averages(knots, order), tensor, limits)
        net, u, v, errors, found = _iterated(method, room, problem, net, u, v)
    else:
        errors = lax.stop_gradient(distances(data - tensor.times(net), limits.diagonal))
        history = ErrorHistory.start(room, errors)
        found = Corrected(net, u, v, history, zero, rest, zero, jnp.asarray(False))
    change = jnp.where(found.number > 0, found.change, rest)
    return Solution(
        net, knots, u, v, errors, found.history, extent_of(data), found.number, change, found.lost
    )


def _iterated(
    method: StandardInterpolation, room: int, problem: CollocationProblem, net: Array, u: Array, v: Array
) -> tuple[Array, Array, Array, Array, Corrected]:
    """The general system, from the net of the tensor product, and corrections of the parameters."""
    fixed, net, start_u, start_v = lax.stop_gradient((problem, net, u, v))
    history = ErrorHistory.start(room, fixed.errors(net, start_u, start_v))
    found = solved_at(method, fixed, net, start_u, start_v, history)
    if method.parameter_correction:
        found = corrected(method, fixed, found)
    found = lax.stop_gradient(found)
    # Derivatives see the first parameters, moved by constants.
    u, v = u + (found.u - start_u), v + (found.v - start_v)
    net = with_derivative(method.restart, found.net, (u, v), problem.axes, problem.tensor, problem.data)
    return net, u, v, fixed.errors(found.net, found.u, found.v), found
