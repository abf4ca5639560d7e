"""A preconditioner for coupled normal matrices: their own factors on small nets, else an uncoupled factor in
rotated frames.
"""

from functools import partial, reduce
from operator import add
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._normal_equations._block_cholesky import Factors, factorise, substitute
from jaxfit._normal_equations._conjugate_gradients import CGSolution, conjugate_gradients
from jaxfit._normal_equations._coupled_stencil import CoupledStencil
from jaxfit._normal_equations._stencil import Stencil
from jaxfit._unrolling import unrolled

LEAST_SHARE = 1e-12  # of a coordinate direction in what a control point weighs
# Up to here the factors of the matrix take no more time than the iterations they save, and what is solved
# exactly hardly depends on how sums are rounded: control points along the shorter side, and in all.
FACTORED_SIDE, FACTORED_POINTS = 24, 1000


class CoupledPreconditioner(eqx.Module):
    r"""$S^{-1/2} (M_0^{-1} \otimes I)\, S^{-1/2}$ with an uncoupled matrix M_0 and a block S_ij for each
    control point.

    S_ij is the block of control point (i, j) with itself, divided by what M_0 has there: about
    $\Pi + \mu (I - \Pi)$ for the normal around (i, j). Where normals vary slowly over the support of a basis
    function, $S^{1/2} (M_0 \otimes I) S^{1/2}$ is nearly the matrix. Without `roots` the factors are those of
    the matrix itself.
    """

    factors: Factors
    roots: Float[Array, "d d nu nv"] | None  # S^(-1/2)

    def __call__(self, right: Float[Array, "nu nv d"]) -> Float[Array, "nu nv d"]:
        """Near the solution."""
        return jnp.moveaxis(self.coordinates_first(jnp.moveaxis(right, 2, 0)), 0, 2)

    def coordinates_first(self, right: Float[Array, "d nu nv"]) -> Float[Array, "d nu nv"]:
        """The same for nets that have their coordinates first."""
        return self._rotated(substitute(self.factors, self._rotated(right)))

    def _rotated(self, x: Float[Array, "d nu nv"]) -> Float[Array, "d nu nv"]:
        if self.roots is None:
            return x
        products = self.roots * x[:, None]
        # Added one by one: a sum over the first axis takes a CPU ten times as long where nets are large.
        return reduce(add, lax.split(products, (1,) * x.shape[0], 0)).reshape(x.shape)


def coupled_preconditioner(
    matrix: CoupledStencil, uncoupled: Stencil, free: Bool[Array, "nu nv"]
) -> CoupledPreconditioner:
    """For the matrix on the free control points, those where `uncoupled` has a positive diagonal. Small nets
    do not use `uncoupled`.
    """
    if min(free.shape) <= FACTORED_SIDE and free.shape[0] * free.shape[1] <= FACTORED_POINTS:
        return CoupledPreconditioner(factorise(matrix, free), None)
    diagonal = jnp.where(free, uncoupled.diagonal, 1.0)[:, :, None, None]
    blocks = matrix.blocks / diagonal
    unit = jnp.eye(blocks.shape[-1], dtype=diagonal.dtype)
    roots = inverse_roots(jnp.where(free[:, :, None, None], blocks, unit[None, None]))
    return CoupledPreconditioner(factorise(uncoupled, free), roots)


def inverse_roots(blocks: Float[Array, "nu nv d d"]) -> Float[Array, "d d nu nv"]:
    """The symmetric square roots of the inverses of symmetric blocks."""
    # A short row at a time: LAPACK's threads divide some 1,500 small matrices among themselves, and two fits
    # at once, as on two devices, then wait for each other's for ever.
    short = blocks.shape[1] <= blocks.shape[0]
    rows = blocks if short else blocks.swapaxes(0, 1)
    values, vectors = lax.map(partial(jnp.linalg.eigh, symmetrize_input=False), rows)
    scaled = vectors * lax.rsqrt(jnp.maximum(values, LEAST_SHARE))[:, :, None, :]
    along = "ijab,ijcb->acij" if short else "jiab,jicb->acij"
    return jnp.einsum(along, scaled, vectors, precision="highest")


def solve_coupled(
    matrix: CoupledStencil,
    right: Float[Array, "nu nv d"],
    free: Bool[Array, "nu nv"],
    preconditioner: CoupledPreconditioner,
    rtol: float,
    max_steps: Any,
) -> CGSolution:
    """The solution on the free control points, 0 elsewhere, by conjugate gradients."""
    product, nearby, inside = matrix.product(), preconditioner.coordinates_first, free[None]

    def masked(x: Array) -> Array:
        return jnp.where(inside, product(x), 0.0)

    right = jnp.where(inside, right.transpose(2, 0, 1), 0.0)
    solution = conjugate_gradients(masked, right, nearby, rtol, max_steps, coupled=True)
    if unrolled():  # its transpose begins here, and needs a right-hand side that is masked as well
        solution = solution._replace(net=jnp.where(inside, solution.net, 0.0))
    return solution._replace(net=solution.net.transpose(1, 2, 0))
