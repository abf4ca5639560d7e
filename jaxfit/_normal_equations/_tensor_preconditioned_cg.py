"""Conjugate gradients on the normal matrix of a very large net."""

from typing import Any

import jax.numpy as jnp
import lineax as lx
from jax import Array
from jaxtyping import Float

from jaxfit._normal_equations._conjugate_gradients import conjugate_gradients
from jaxfit._splines import _banded


class TensorPreconditionedCG(lx.AbstractLinearSolver):
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
        """The solution for one right-hand side, every channel by itself."""
        del options
        operator, factors = state

        def preconditioner(x: Array) -> Array:
            return _preconditioned(factors, x)

        found = conjugate_gradients(
            operator.mv, vector, preconditioner, self.rtol, self.max_steps, coupled=False
        )
        result = lx.RESULTS.where(found.met, lx.RESULTS.successful, lx.RESULTS.max_steps_reached)
        return found.net, result, {"num_steps": found.steps, "max_steps": self.max_steps}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        """The matrix is symmetric."""
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        """The matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """CG stays within the range of a singular matrix, where the right-hand sides of fits lie."""
        return True


def _preconditioned(factors: tuple[Array, Any, Any], x: Float[Array, "nu nv c"]) -> Float[Array, "nu nv c"]:
    root, along_u, along_v = factors
    nu, nv, channels = x.shape
    x = (x / root).reshape(nu, nv * channels)
    x = _banded.substitute(along_u, x).reshape(nu, nv, channels).transpose(1, 0, 2)
    x = _banded.substitute(along_v, x.reshape(nv, nu * channels)).reshape(nv, nu, channels)
    return x.transpose(1, 0, 2) / root


def _tensor_factors(operator: Any) -> tuple[Array, Any, Any]:
    """The root of the diagonal, and the factored bands along both directions."""
    free = jnp.asarray(operator.free)
    entries = jnp.where(free[None, None], operator.stencil.entries, 0.0)
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
