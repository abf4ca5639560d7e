r"""The least-squares problem of equation (8): points at given parameters, and a thin plate.

$$F(P) = \sum_k w_k |R(u_k, v_k) - Q_k|^2 + \lambda F_s
       = \left| \begin{matrix} \sqrt{w} (A P - Q) \\ \sqrt{\lambda} L P \end{matrix} \right|^2 $$

over the free control points; the others stay where they are and go to the right-hand side. Nothing here
is of the size points times control points.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._cells import (
    Rows,
    cells_to_net,
    evaluate_values,
    local_coordinates,
    row_coefficients,
    row_width,
    rows_of,
)
from jaxfit._normal_equations._normal_matrix import cell_moments, normal_stencil
from jaxfit._normal_equations._stencil import Stencil
from jaxfit._normal_equations._thin_plate import Bending, ThinPlate, thin_plate
from jaxfit._splines._pieces import Axis, Pieces, pieces_on
from jaxfit._unrolling import constant, without_influence

LEAST_INFLUENCE = 1e-5  # of the greatest diagonal entry to solve for: control points reached by less stay

Residual = tuple[Float[Array, "d rows width"], Bending]


class RegularisedSystem(eqx.Module):
    """Points in rows, with their weights (0 for empty slots) and the square roots of these."""

    rows: Rows
    s: Float[Array, "rows width"]
    t: Float[Array, "rows width"]
    weight: Float[Array, "rows width"]
    root: Float[Array, "rows width"]
    target: Float[Array, "d rows width"]
    axis_u: Axis
    axis_v: Axis
    plate: ThinPlate
    smoothing: Float[Any, ""]

    def data_stencil(self) -> Stencil:
        """A^T W A."""
        return normal_stencil(self.rows, self.s, self.t, self.weight, self.axis_u, self.axis_v)

    def stencil(self) -> Stencil:
        """The normal matrix A^T W A + lambda A_fair of (11)."""
        return self.data_stencil().plus(self.plate.stencil().times(self.smoothing))

    def data_residual(self, net: Float[Array, "nu nv d"]) -> Float[Array, "d rows width"]:
        """sqrt(w) (A P - Q)."""
        return self.root[None] * self.distances(net)

    def distances(self, net: Float[Array, "nu nv d"]) -> Float[Array, "d rows width"]:
        """A P - Q."""
        pieces = pieces_on(net, self.axis_u, self.axis_v)
        return evaluate_values(row_coefficients(pieces, self.rows), self.s, self.t) - self.target

    def residual(self, net: Float[Array, "nu nv d"]) -> Residual:
        """Both parts of what is squared and summed."""
        root = jnp.sqrt(jnp.asarray(self.smoothing, net.dtype))
        return self.data_residual(net), root * self.plate.residual(net)

    def adjoint(self, residual: Residual) -> Float[Array, "nu nv d"]:
        """The transposed Jacobian times a residual: half the gradient of F, at `residual(net)`."""
        data, bending = residual
        root = jnp.sqrt(jnp.asarray(self.smoothing, data.dtype))
        return self.data_adjoint(data) + root * self.plate.adjoint(bending)

    def data_adjoint(self, residual: Float[Array, "d rows width"]) -> Float[Array, "nu nv d"]:
        """A^T sqrt(w) times a residual of the data."""
        return self.summed(self.root[None] * residual)

    def half_gradient(self, net: Float[Array, "nu nv d"]) -> Float[Array, "nu nv d"]:
        """Half the gradient of F, in a form that is differentiable in weights and lambda that are 0."""
        data = self.summed(self.weight[None] * self.distances(net))
        return data + self.smoothing * self.plate.adjoint(self.plate.residual(net))

    def summed(self, values: Float[Array, "d rows width"]) -> Float[Array, "nu nv d"]:
        """A^T times values at the points."""
        polynomials = self.axis_u.polynomials, self.axis_v.polynomials
        orders, cells = [x.shape[1] for x in polynomials], self.axis_u.cells * self.axis_v.cells
        moments = cell_moments(self.rows, self.s, self.t, values, (orders[0], orders[1]), cells)
        return cells_to_net(moments, *polynomials)


def make_system(
    pieces: Pieces,
    u: Float[Any, " points"],
    v: Float[Any, " points"],
    target: Float[Any, "d points"],
    weight: Float[Any, " points"],
    smoothing: Float[Any, ""],
    plate: ThinPlate | None = None,
) -> RegularisedSystem:
    """Points with parameters (u, v) laid out on the cells of `pieces`, whose net does not matter; their thin
    plate may be given.
    """
    width = row_width(u.shape[0], pieces.cells)
    rows = rows_of(pieces, u, v, width, without_influence(weight))

    def in_rows() -> tuple[Array, Array, Array, Array, Array]:
        spread = rows.spread(jnp.concatenate([jnp.stack([u, v, weight]), target]))
        s, t = local_coordinates(pieces, rows.cell[:, None], spread[0], spread[1])
        own = jnp.where(rows.filled, spread[2], 0.0)
        return s, t, own, jnp.sqrt(constant(own)), spread[3:]

    s, t, own, root, goal = materialise(u[0] >= pieces.axis_u.breaks[0], in_rows)
    plate = thin_plate(pieces.axis_u, pieces.axis_v) if plate is None else plate
    return RegularisedSystem(rows, s, t, own, root, goal, pieces.axis_u, pieces.axis_v, plate, smoothing)


def free_points(stencil: Stencil, held: Bool[Any, "nu nv"]) -> Bool[Array, "nu nv"]:
    """Control points to solve for: not held, and reached by some point or by smoothing.

    The others keep their value: those that data touches at most with the far end of a basis function when
    there is no smoothing, and would throw anywhere, and surplus ones behind repeated end knots.
    """
    reached, held = jnp.asarray(stencil.diagonal), jnp.asarray(held)
    return ~held & (reached > LEAST_INFLUENCE * jnp.max(reached * ~held))
