"""Bounds that keep the feet of a grid in the order of its points.

While the surface is far from the data, as where sections of very different size follow one another, closest
points may slide past those of their neighbours. The control point then has hardly any influence on the
surface at its own foot, and no iteration with these feet converges. A foot stays where it was if its closest
point lies beyond the middle between its own first parameters and those of its neighbours.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxfit._checks import is_concrete


def bounds_between(
    u: Float[Any, " points"], v: Float[Any, " points"], nu: int, nv: int
) -> Float[Any, "2 2 points"]:
    """Least and greatest (u, v) of each foot of a grid whose first feet are `u` and `v`."""
    along_u = _middles(u.reshape(nu, nv))
    along_v = _middles(v.reshape(nu, nv).T).swapaxes(1, 2)
    return _array_module(u, v).stack([along_u, along_v], axis=1).reshape(2, 2, nu * nv)


def is_within(feet: Float[Any, "2 points"], bounds: Float[Any, "2 2 points"]) -> Bool[Any, " points"]:
    """Whether both parameters of each foot are."""
    return ((feet >= bounds[0]) & (feet <= bounds[1])).all(axis=0)


def _middles(x: Any) -> Any:
    """Between each row and the one before, and the one after; infinite where there is none."""
    xp = _array_module(x)
    middle, none = 0.5 * (x[1:] + x[:-1]), xp.full_like(x[:1], np.inf)
    return xp.stack([xp.concatenate([-none, middle]), xp.concatenate([middle, none])])


def _array_module(*arrays: Any) -> Any:
    return np if is_concrete(arrays) else jnp
