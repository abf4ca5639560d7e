"""The normal matrix as a `lineax` operator, and its direct solver."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._normal_equations._block_cholesky import Factors, factorise, substitute
from jaxfit._normal_equations._stencil import Stencil
from jaxfit._normal_equations._tensor_preconditioned_cg import TensorPreconditionedCG

# Factors of more numbers than this (512 MiB in double precision) are not stored: CG takes over.
MOST_FACTORS = 1 << 26


class NormalOperator(lx.AbstractLinearOperator):
    """A stencil on the free control points of a net; the others have identity rows.

    Acts on nets (nu, nv, channels), every channel for itself. Differentiable in the stencil's entries.
    """

    stencil: Stencil
    free: Bool[Any, "nu nv"]
    channels: int = eqx.field(static=True)

    def mv(self, vector: Float[Array, "nu nv c"]) -> Float[Array, "nu nv c"]:
        """The matrix times a net."""
        free = jnp.asarray(self.free)[:, :, None]
        return jnp.where(free, self.stencil(jnp.where(free, vector, 0.0)), vector)

    def as_matrix(self) -> Float[Array, "n n"]:
        """All entries; for small nets."""
        size = self.in_size()
        unit = jnp.eye(size, dtype=self.stencil.entries.dtype)
        columns = jax.vmap(lambda x: self.mv(x.reshape(self.in_structure().shape)).reshape(-1))(unit)
        return columns.T

    def transpose(self) -> "NormalOperator":
        """Itself."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """A net."""
        shape = (*self.free.shape, self.channels)
        return jax.ShapeDtypeStruct(shape, self.stencil.entries.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """A net."""
        return self.in_structure()


for _is in (lx.is_symmetric, lx.is_positive_semidefinite):
    _is.register(NormalOperator)(lambda operator: True)
for _is in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_negative_semidefinite,
    lx.has_unit_diagonal,
):
    _is.register(NormalOperator)(lambda operator: False)
for _same in (lx.linearise, lx.materialise, lx.conj):
    _same.register(NormalOperator)(lambda operator: operator)


@lx.diagonal.register(NormalOperator)
def _diagonal(operator: NormalOperator) -> Array:
    diagonal = jnp.where(operator.free, operator.stencil.diagonal, 1.0)
    return jnp.broadcast_to(diagonal[..., None], operator.in_structure().shape).reshape(-1)


class BlockCholesky(lx.AbstractLinearSolver):
    """Direct solution of a `NormalOperator`, by `factorise`; what is nearly singular is shifted.

    `stats["shift"]` is the share of the diagonal that had to be added, 0 for a regular matrix.
    """

    def init(self, operator: Any, options: dict[str, Any]) -> Factors:
        """The factors."""
        del options
        return factorise(operator.stencil, jnp.asarray(operator.free))

    def compute(self, state: Factors, vector: Any, options: dict[str, Any]) -> Any:
        """The solution for one right-hand side, all its channels together."""
        del options
        solution = substitute(state, vector.transpose(2, 0, 1)).transpose(1, 2, 0)
        return solution, lx.RESULTS.successful, {"shift": state.shift}

    def transpose(self, state: Factors, options: dict[str, Any]) -> Any:
        """The matrix is symmetric."""
        return state, options

    def conj(self, state: Factors, options: dict[str, Any]) -> Any:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """After shifting it has."""
        return True


def normal_solver(operator: NormalOperator) -> BlockCholesky | TensorPreconditionedCG:
    """Block Cholesky while its factors fit in memory comfortably, CG beyond."""
    order_u, order_v, nu, nv = operator.stencil.entries.shape
    size = nu * order_u * nv**2 if nv <= nu else nv * order_v * nu**2
    return BlockCholesky() if size <= MOST_FACTORS else TensorPreconditionedCG()
