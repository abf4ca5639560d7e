"""Conjugate gradients on a coupled normal matrix, preconditioned by uncoupled factors in turned frames."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float

from jaxfit._normal_equations._coupled import CoupledStencil
from jaxfit._normal_equations._elimination import Factors, factorise, substitute
from jaxfit._normal_equations._stencil import Stencil

LEAST_SHARE = 1e-12  # of a coordinate direction in what a control point weighs


class Preconditioner(eqx.Module):
    r"""$S^{-1/2} (M_0^{-1} \otimes I)\, S^{-1/2}$ with an uncoupled matrix M_0 and a block S_ij for each
    control point.

    S_ij is the block of control point (i, j) with itself, divided by what M_0 has there: about
    $\Pi + \mu (I - \Pi)$ for the normal around (i, j). Where normals vary slowly over the support of a basis
    function, $S^{1/2} (M_0 \otimes I) S^{1/2}$ is nearly the matrix.
    """

    factors: Factors
    roots: Float[Array, "nu nv d d"]  # S^(-1/2)

    def __call__(self, right: Float[Array, "nu nv d"]) -> Float[Array, "nu nv d"]:
        """Near the solution."""
        return self._turned(substitute(self.factors, self._turned(right)))

    def _turned(self, x: Float[Array, "nu nv d"]) -> Float[Array, "nu nv d"]:
        return jnp.sum(self.roots * x[:, :, None, :], axis=-1)


def preconditioner(matrix: CoupledStencil, uncoupled: Stencil, free: Bool[Array, "nu nv"]) -> Preconditioner:
    """For the matrix on the free control points, those where `uncoupled` has a positive diagonal."""
    diagonal = jnp.where(free, uncoupled.diagonal, 1.0)[:, :, None, None]
    unit = jnp.eye(matrix.dimension, dtype=diagonal.dtype)[None, None]
    shares = jnp.where(free[:, :, None, None], matrix.blocks / diagonal, unit)
    values, vectors = jnp.linalg.eigh(shares)
    values = lax.rsqrt(jnp.maximum(values, LEAST_SHARE))
    roots = jnp.einsum("ijab,ijb,ijcb->ijac", vectors, values, vectors, precision="highest")
    return Preconditioner(factorise(uncoupled, free), roots)


def coupled_cg(
    matrix: CoupledStencil,
    right: Float[Array, "nu nv d"],
    free: Bool[Array, "nu nv"],
    near: Any,
    rtol: float,
    most: int,
) -> Float[Array, "nu nv d"]:
    """The solution on the free control points, 0 elsewhere, or what `most` iterations give.

    Stops where the residual, in the norm of the preconditioner `near`, is `rtol` times the right-hand side.
    Stopped anywhere it is a direction of descent: the quadratic model falls from one iteration to the next.
    """
    inside = free[:, :, None]
    right = jnp.where(inside, right, 0.0)

    def unfinished(carry: Any) -> Array:
        _, _, _, slope, steps = carry
        return (slope > goal) & (steps < most)

    def step(carry: Any) -> Any:
        net, left, along, slope, steps = carry
        image = jnp.where(inside, matrix(along), 0.0)
        bend = jnp.sum(along * image)
        length = jnp.where(bend > 0, slope / jnp.where(bend > 0, bend, 1.0), 0.0)
        net, left = net + length * along, left - length * image
        following = near(left)
        after = jnp.where(bend > 0, jnp.sum(left * following), 0.0)
        return net, left, following + after / slope * along, after, steps + 1

    first = near(right)
    slope = jnp.sum(right * first)
    goal = rtol**2 * slope
    begin = (jnp.zeros_like(right), right, first, slope, jnp.asarray(0, jnp.int32))
    return lax.while_loop(unfinished, step, begin)[0]
