"""The normal matrix as a `lineax` operator, and its solvers: block Cholesky, and CG for very large nets."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._normal._elimination import Factors, factorise, substitute
from jaxfit._normal._stencil import Stencil
from jaxfit._splines import _banded

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
    """Direct solution of a `NormalOperator`, by `factorise`; what is singular to rounding is shifted.

    `stats["shift"]` is the share of the diagonal that had to be added, 0 for a regular matrix.
    """

    def init(self, operator: Any, options: dict[str, Any]) -> Factors:
        """The factors."""
        del options
        return factorise(operator.stencil, jnp.asarray(operator.free))

    def compute(self, state: Factors, vector: Any, options: dict[str, Any]) -> Any:
        """The solution for one right-hand side, all its channels together."""
        del options
        return substitute(state, vector), lx.RESULTS.successful, {"shift": state.shift}

    def transpose(self, state: Factors, options: dict[str, Any]) -> Any:
        """The matrix is symmetric."""
        return state, options

    def conj(self, state: Factors, options: dict[str, Any]) -> Any:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """After shifting it has."""
        return True


class TensorCG(lx.AbstractLinearSolver):
    """Conjugate gradients on a `NormalOperator`, in memory of the size of the net.

    Preconditioned by D^(1/2) (T_u x T_v) D^(1/2), with the diagonal D and the mean over all rows and over
    all columns of the matrix scaled to unit diagonal: the matrix itself where the data is spread like a
    product, and near it where its density varies slowly.
    """

    rtol: float = 1e-10
    max_steps: int = 1000

    def init(self, operator: Any, options: dict[str, Any]) -> Any:
        """The operator, and the factors of the preconditioner."""
        del options
        return operator, _tensor_factors(operator)

    def compute(self, state: Any, vector: Any, options: dict[str, Any]) -> Any:
        """The solution for one right-hand side."""
        del options
        operator, (root, along_u, along_v) = state

        def precondition(x: Array) -> Array:
            nu, nv, channels = x.shape
            x = (x / root).reshape(nu, nv * channels)
            x = _banded.substitute(along_u, x).reshape(nu, nv, channels).transpose(1, 0, 2)
            x = _banded.substitute(along_v, x.reshape(nv, nu * channels)).reshape(nv, nu, channels)
            return x.transpose(1, 0, 2) / root

        tag = lx.positive_semidefinite_tag
        near = lx.FunctionLinearOperator(precondition, operator.in_structure(), tag)
        inner = lx.CG(self.rtol, 0.0, max_steps=self.max_steps)
        settings = {"preconditioner": near}
        return inner.compute(inner.init(operator, settings), vector, settings)

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        """The matrix is symmetric."""
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """CG stays within the range of a singular matrix, where the right-hand sides of fits lie."""
        return True


def _tensor_factors(operator: NormalOperator) -> tuple[Array, Any, Any]:
    """The root of the diagonal, and the factored bands along both directions."""
    free = jnp.asarray(operator.free)
    entries = jnp.where(free, operator.stencil.entries, 0.0)
    root = jnp.sqrt(jnp.where(free, operator.stencil.diagonal, 1.0))
    scaled = root * jnp.where(free, 1.0, jnp.inf)  # couples no fixed control point
    bands = [_mean_band(entries[:, 0], scaled), _mean_band(entries[0].transpose(0, 2, 1), scaled.T)]
    along_u, along_v = (_banded.factorise(band) for band in bands)
    return root[:, :, None], along_u, along_v


def _mean_band(entries: Float[Array, "K n m"], root: Float[Array, "n m"]) -> Float[Array, "n band"]:
    """Entries (i, i + a) scaled to unit diagonal, averaged over the other direction, as a full band."""
    order, count, _ = entries.shape
    ahead = jnp.pad(root, ((0, order - 1), (0, 0)), constant_values=jnp.inf)
    upper = [jnp.mean(entries[a] / (root * ahead[a : a + count]), axis=1) for a in range(1, order)]
    lower = [jnp.pad(x, (a, 0))[:count] for a, x in enumerate(upper, 1)]
    return jnp.stack([*lower[::-1], jnp.ones(count, entries.dtype), *upper], axis=1)


def normal_solver(operator: NormalOperator) -> BlockCholesky | TensorCG:
    """Block Cholesky while its factors fit in memory comfortably, CG beyond."""
    order_u, order_v, nu, nv = operator.stencil.entries.shape
    size = nu * order_u * nv**2 if nv <= nu else nv * order_v * nu**2
    return BlockCholesky() if size <= MOST_FACTORS else TensorCG()
