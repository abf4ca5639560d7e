"""The weights of geometric interpolation: the share of its error vector by which a control point moves."""

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar
from jax import Array, lax
from jaxtyping import Float

from jaxfit._compile import compiled
from jaxfit._interpolation._per_point_collocation import PointCollocation, basis_at
from jaxfit._splines._pieces import Axis

POWER_ITERATIONS = 100


class AbstractRepositioning(eqx.Module):
    """The factor w in P += w e."""

    needs_spectrum: AbstractClassVar[bool]

    @abstractmethod
    def weights(self, collocation: PointCollocation, lowest: Array) -> Float[Array, "nu nv"]:
        """Of every control point; `lowest` is the smallest eigenvalue of the collocation matrix."""


class UnitWeights(AbstractRepositioning):
    """The plain iteration (14): w = 1.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(repositioning=jf.UnitWeights()).repositioning
    UnitWeights()
    """

    needs_spectrum: ClassVar[bool] = False

    def weights(self, collocation: PointCollocation, lowest: Array) -> Float[Array, "nu nv"]:
        """Ones."""
        return jnp.ones_like(collocation.basis_u[0])


class OptimalRepositioning(AbstractRepositioning):
    r"""Weights that would meet each point at once if it were alone, equation (27).

    $$w_{ij} = \frac{N_i(\hat u) N_j(\hat v)}{\sum_k N_k^2(\hat u) \sum_l N_l^2(\hat v)}$$

    at the closest point of $Q_{ij}$. Where the control point's own basis functions vanish there, w = 1.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(repositioning=jf.OptimalRepositioning()).repositioning
    OptimalRepositioning()
    """

    needs_spectrum: ClassVar[bool] = False

    def weights(self, collocation: PointCollocation, lowest: Array) -> Float[Array, "nu nv"]:
        """Equation (27)."""
        own_u, own_v = collocation.own()
        squares = jnp.sum(collocation.basis_u**2, axis=0) * jnp.sum(collocation.basis_v**2, axis=0)
        own = own_u * own_v
        return jnp.where(own > 0, own / squares, 1.0)


class ConstantWeight(AbstractRepositioning):
    r"""Lu's constant weight, equation (17): $w = 2 / (1 + \lambda_{\min}(N_1) \lambda_{\min}(N_2))$.

    The eigenvalues are those of the collocation matrices of both directions at the averaged parameters.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(repositioning=jf.ConstantWeight()).repositioning
    ConstantWeight()
    """

    needs_spectrum: ClassVar[bool] = True

    def weights(self, collocation: PointCollocation, lowest: Array) -> Float[Array, "nu nv"]:
        """Equation (17)."""
        return jnp.full_like(collocation.basis_u[0], 2.0 / (1.0 + lowest))


@compiled
def lowest_eigenvalue(axes: tuple[Axis, Axis], parameters: tuple[Array, Array]) -> Float[Array, ""]:
    """The smallest eigenvalue of the tensor product of both directions' collocation matrices.

    These are totally positive with rows that sum to 1, so their eigenvalues are real and lie between 0 and 1:
    power iteration on the identity minus the matrix finds the smallest, from above.
    """
    lowest = [_lowest(axis, x) for axis, x in zip(axes, parameters, strict=True)]
    return lowest[0] * lowest[1]


def _lowest(axis: Axis, u: Array) -> Float[Array, ""]:
    first, basis = basis_at(axis, u)
    columns = jnp.arange(u.shape[0], dtype=jnp.int32)
    terms = [
        jnp.where((first + r)[:, None] == columns[None, :], x[:, None], 0.0) for r, x in enumerate(basis)
    ]
    rest = jnp.eye(u.shape[0], dtype=u.dtype) - sum(terms[1:], terms[0])
    # Close to the eigenvector, which changes sign at every step.
    start = jnp.where(columns % 2 == 0, 1.0, -0.9).astype(u.dtype)

    def power_step(_: Any, x: Array) -> Array:
        y = jnp.matmul(rest, x, precision="highest")
        return y / jnp.linalg.norm(y)

    x = lax.fori_loop(0, POWER_ITERATIONS, power_step, start / jnp.linalg.norm(start))
    return 1.0 - jnp.linalg.norm(jnp.matmul(rest, x, precision="highest"))
