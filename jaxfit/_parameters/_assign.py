"""Parameters along a curve and along the rows and columns of a grid (paper section 2.2)."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfit._checks import as_floating, as_points, is_concrete
from jaxfit._compile import compiled
from jaxfit._parameters._methods import AbstractParametrisation, ChordLength

_CHORD_LENGTH = ChordLength()


class GridParameters(NamedTuple):
    """Parameters of a grid of n x m points, all on [0, 1].

    `u` (n,) and `v` (m,) are the averages that give the knot vectors. `rows_u` (n, m) and
    `rows_v` (n, m) are each point's own parameters, measured along its own row of the grid;
    the paper keeps them as starting values of the closest-point search.
    """

    u: Array
    v: Array
    rows_u: Array
    rows_v: Array


def curve_parameters(
    points: ArrayLike, method: AbstractParametrisation = _CHORD_LENGTH
) -> Float[Array, " points"]:
    r"""Parameters of a row of points on [0, 1], strictly increasing.

    $$u_0 = 0, \qquad u_i = u_{i-1} + |Q_i - Q_{i-1}|^a / \sum_k |Q_k - Q_{k-1}|^a,$$

    with `a = method.exponent`. A step shorter than eps^(1/3) of the mean step (6e-6 in float64,
    5e-3 in float32), such as that between two equal neighbours, is lengthened to that and the
    whole rescaled, so that knots averaged from the result never coincide.

    Parameters
    ----------
    points : array (n, d)
        At least two, in any unit.
    method : ChordLength() or Centripetal()

    Returns
    -------
    array (n,)

    Raises
    ------
    ValueError
        For fewer than two points, NaNs, and points that are all equal. Inside `jit` values cannot be
        checked: points that are all equal then give uniform parameters.

    Notes
    -----
    Source: NURBS Book, equations (9.4) to (9.6).

    Examples
    --------
    >>> import jaxfit as jf
    >>> import numpy as np
    >>> print(np.round(jf.curve_parameters(np.asarray([[0.0, 0.0], [3.0, 4.0], [3.0, 9.0]])), 8))
    [0.  0.5 1. ]
    """
    column = jnp.asarray(as_points("points", points, least=2))[:, None]
    steps, length = _rows(column, method.exponent)
    usable = _usable(column, length)
    if is_concrete(usable) and not bool(usable[0]):
        raise ValueError(
            "points must not all be equal, since a curve of length zero has no parameters; "
            "leave this curve out."
        )
    return _strict(_averaged(steps, usable), "points")


def grid_parameters(grid: ArrayLike, method: AbstractParametrisation = _CHORD_LENGTH) -> GridParameters:
    """Parameters of grid data: per row and column, and averaged over the other direction.

    Every row (fixed j, running i) gets parameters as in `curve_parameters`; their mean over j is
    `u`, and the same with i and j exchanged is `v`. Both are on [0, 1] and strictly increasing:
    averaged steps are lengthened to eps^(1/3) of the mean step where they are shorter.

    A row whose points are all equal to rounding, such as the pole of a closed surface, has no
    parameters of its own: it is left out of the average and takes the average itself in
    `rows_u` (`rows_v`). `rows_u` and `rows_v` may repeat values where points repeat.

    Parameters
    ----------
    grid : array (n, m, d)
        At least 2 x 2 points, in any unit. Jit, vmap and grad work.
    method : ChordLength() or Centripetal()

    Returns
    -------
    GridParameters
        Arrays `u` (n,), `v` (m,), `rows_u` (n, m) and `rows_v` (n, m).

    Raises
    ------
    ValueError
        For a grid with fewer than 2 x 2 points, for NaNs, and where the rows of one direction are all
        degenerate (inside `jit` that gives uniform parameters instead).

    Notes
    -----
    Source: NURBS Book, algorithm A9.3.

    Examples
    --------
    >>> import jaxfit as jf
    >>> import numpy as np
    >>> x, y = np.meshgrid([0.0, 1.0, 4.0], [0.0, 2.0], indexing="ij")
    >>> parameters = jf.grid_parameters(np.stack([x, y], axis=-1))
    >>> print(np.round(parameters.u, 8), np.round(parameters.v, 8))
    [0.   0.25 1.  ] [0. 1.]
    """
    grid = jnp.asarray(as_floating("grid", grid, 3))
    if grid.shape[0] < 2 or grid.shape[1] < 2 or grid.shape[2] < 1:
        raise ValueError(
            f"grid must hold at least 2 x 2 points, but has shape {grid.shape}; give an array (n, m, d)."
        )
    u, rows_u = _direction(grid, method.exponent, "first")
    v, columns_v = _direction(jnp.swapaxes(grid, 0, 1), method.exponent, "second")
    return GridParameters(u, v, rows_u, columns_v.T)


def _direction(grid: Array, exponent: float, which: str) -> tuple[Array, Array]:
    steps, lengths = _rows(grid, exponent)
    usable = _usable(grid, lengths)
    if is_concrete(usable) and not bool(usable.any()):
        raise ValueError(
            f"grid must extend along its {which} index, but every row of points along it has "
            "length zero; give a grid of distinct points."
        )
    average = _strict(_averaged(steps, usable), "grid")
    return average, _own(steps, usable, average)


@partial(compiled, static_argnames="exponent")
def _rows(grid: Array, exponent: float) -> tuple[Array, Array]:
    """Steps |dQ|^exponent (n-1, m), each column scaled to sum to 1, and the lengths (m,)."""
    differences = jnp.diff(grid, axis=0)
    # Unit-free: squares of very small or very large coordinates would leave the number range.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(differences)))
    differences = differences / jnp.where(scale > 0, scale, 1)
    squares = jnp.sum(differences**2, axis=-1)
    positive = squares > 0
    distances = jnp.sqrt(jnp.where(positive, squares, 1))  # d sqrt(x) at x = 0 is infinite
    steps = jnp.where(positive, distances**exponent, 0)
    lengths = scale * jnp.sum(jnp.where(positive, distances, 0), axis=0)
    total = jnp.sum(steps, axis=0, keepdims=True)
    return steps / jnp.where(total > 0, total, 1), lengths


@compiled
def _usable(grid: Array, lengths: Array) -> Array:
    """Which columns are longer than the rounding of their coordinates adds up to."""
    noise = 4 * jnp.finfo(grid.dtype).eps * jnp.max(jnp.abs(grid))
    return lengths > noise * (grid.shape[0] - 1)


@compiled
def _averaged(steps: Array, usable: Array) -> Array:
    """Mean of the usable columns' parameters, with a least step; uniform if there are none."""
    count = steps.shape[0]
    columns = jnp.where(usable[None, :], steps, 0)
    mean = jnp.sum(columns, axis=1) / jnp.maximum(jnp.sum(usable), 1)
    mean = jnp.where(jnp.any(usable), mean, 1 / count)
    eps = float(jnp.finfo(steps.dtype).eps)
    return _cumulated(jnp.maximum(mean, max(eps ** (1 / 3) / count, 4 * eps))[:, None])[:, 0]


@compiled
def _own(steps: Array, usable: Array, average: Array) -> Array:
    """Each column's own parameters; the average where the column has no length."""
    own = _cumulated(jnp.where(usable[None, :], steps, 1))
    return jnp.where(usable[None, :], own, average[:, None])


def _cumulated(steps: Array) -> Array:
    sums = jnp.cumsum(steps, axis=0)
    return jnp.concatenate([jnp.zeros_like(sums[:1]), sums / sums[-1:]])


def _strict(parameters: Array, name: str) -> Array:
    if is_concrete(parameters) and not (np.diff(np.asarray(parameters)) > 0).all():
        raise ValueError(
            f"{name} has too many points for distinct parameters in {parameters.dtype}; use "
            "float64 or fewer points."
        )
    return parameters
