"""What fits of grids share at their ends: whether there are parameters and a solution, and how it went."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxfit._checks import is_concrete
from jaxfit._fit._reasons import RESULTS, code_of, result_of
from jaxfit._parameters import AbstractParametrisation, grid_parameters


def extent_of(data: Float[Any, "n m d"]) -> Float[Array, "2"]:
    """How far a grid reaches along either index: if nowhere, its parameters are made up."""
    fixed = lax.stop_gradient(data)
    return jnp.stack([jnp.max(jnp.abs(jnp.diff(fixed, axis=axis))) for axis in (0, 1)])


def is_flat(extent: Any, inner: Any) -> bool:
    """Whether a concrete grid reaches nowhere along one index, but for rounding."""
    noise = 4 * float(np.finfo(inner.dtype).eps) * max(inner.shape)
    return bool((np.asarray(extent) <= noise).any())


def check_solved(
    parametrisation: AbstractParametrisation, order: tuple[int, int], inner: Any, extent: Any, result: Any
) -> None:
    """Raise where a concrete grid has no parameters, or its `result` is not finite."""
    if is_flat(extent, inner):
        # The exact test is the parametrisation's own; no row is shorter than its longest step.
        grid_parameters(inner, parametrisation)
    if not np.isfinite(np.asarray(result)).all():
        raise ValueError(
            f"grid is too unevenly spaced for order {tuple(order)} in {inner.dtype}, since its collocation "
            "matrix is singular to rounding; lower the order, or remove points that repeat."
        )


def ending(maximum: Any, loss: Any, tolerance: Any, met: Any, missed: Any) -> Any:
    """The result of a fit whose largest error, of which `loss` is due to rounding the net, is `maximum`.

    `met` and `missed` are the numbers of the results if the tolerance is, or is not, met before rounding.
    """
    xp: Any = np if is_concrete(maximum, loss, tolerance, met, missed) else jnp
    code = xp.where(maximum - loss <= tolerance, code_of(RESULTS.rounded), missed)
    code = xp.where(maximum <= tolerance, met, code)
    return result_of(xp.where(xp.isfinite(maximum), code, code_of(RESULTS.diverged)))
