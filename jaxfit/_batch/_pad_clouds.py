"""`pad_clouds`: clouds of different sizes in one array."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxfit._checks import as_floating, as_points, is_concrete
from jaxfit._precision import bucket


class PaddedClouds(NamedTuple):
    """Clouds in one array, with the weights that leave out the padding; what `pad_clouds` returns.

    Attributes
    ----------
    points : array (clouds, most, d)
    weights : array (clouds, most)
        0 for padding.

    Examples
    --------
    >>> padded = jf.pad_clouds([np.ones((70, 3)), np.ones((66, 3))])
    >>> isinstance(padded, jf.PaddedClouds), padded.weights.sum(axis=1).tolist()
    (True, [70.0, 66.0])
    """

    points: Float[Any, "clouds most d"]
    weights: Float[Any, "clouds most"]


def pad_clouds(clouds: Sequence[Any], weights: Sequence[ArrayLike] | None = None) -> PaddedClouds:
    """Clouds of different sizes in one array, for `jax.vmap`, `jax.lax.map` and sharding.

    The padding repeats the last point of a cloud and has the weight 0. A fit with these weights leaves it out
    of everything: sums, averages, tolerances, the history and the diagonal of the data.

    Parameters
    ----------
    clouds : sequence of arrays (points, d)
        Not all need to be finite: a fit says so itself.
    weights : sequence of arrays (points,), optional
        Of the points of each cloud (default 1).

    Returns
    -------
    PaddedClouds
        Its length is one of four per octave, so that nearby sizes share a program.

    Raises
    ------
    ValueError
        If there is no cloud, one is empty, or their dimensions or the lengths of weights differ.

    Notes
    -----
    A fit inside a transformation has parameters and errors for the padding, too, which mean nothing. Sums are
    made in another order than without the padding, so that results differ by rounding. `OrthogonalDistance`
    solves its systems with a limited number of conjugate gradient iterations, and these differences grow from
    step to step until the fit has converged: 5e-11 of the diagonal after 5 steps and 7e-8 after 20 for 3,000
    points and 11x15 control points.
    `map_fits` takes clouds of different sizes as they are.

    Examples
    --------
    >>> x, y = np.random.default_rng(0).uniform(size=(2, 90))
    >>> cloud = np.stack([x, y, x * y], axis=1)
    >>> points, weights = jf.pad_clouds([cloud, cloud[:70]])
    >>> points.shape, weights.sum(axis=1).tolist()
    ((2, 96, 3), [90.0, 70.0])
    """
    arrays = [_as_cloud(getattr(cloud, "cloud", cloud), i) for i, cloud in enumerate(clouds)]
    if not arrays:
        raise ValueError("clouds must hold at least one cloud, but is empty; give more.")
    if len({x.shape[1] for x in arrays}) > 1:
        raise ValueError(
            f"clouds must have one dimension, but their points have {sorted({x.shape[1] for x in arrays})} "
            "coordinates; give points of one kind."
        )
    given: Any = [np.ones(len(x)) for x in arrays] if weights is None else list(weights)
    if [np.shape(w) for w in given] != [(len(x),) for x in arrays]:
        raise ValueError(
            "weights must hold one number for each point of each cloud, but their shapes are "
            f"{[np.shape(w) for w in given][:5]}; give an array (points,) for each cloud."
        )
    _check_weights(given)
    xp: Any = np if is_concrete(arrays, given) else jnp
    most = bucket(max(len(x) for x in arrays))
    points = [xp.concatenate([x, xp.repeat(x[-1:], most - len(x), axis=0)]) for x in arrays]
    return PaddedClouds(
        xp.stack(points), xp.stack([xp.pad(xp.asarray(w), (0, most - len(w))) for w in given])
    )


def _as_cloud(cloud: Any, index: int) -> Any:
    """The cloud as an array (points, d); its numbers need not be finite."""
    try:
        array = cloud if hasattr(cloud, "dtype") else np.asarray(cloud, float)
    except (ValueError, TypeError) as error:
        raise ValueError(f"clouds[{index}] is no array (points, d) of numbers; give one.") from error
    concrete = is_concrete(array)
    as_points(f"clouds[{index}]", np.zeros(array.shape, array.dtype) if concrete else array, None)
    return array if np.issubdtype(array.dtype, np.floating) else array.astype(float)


def _check_weights(weights: list[Any]) -> None:
    """Raise unless those that are known are numbers from 0 on."""
    for i, own in enumerate(weights):
        if is_concrete(own) and not np.all(as_floating(f"weights[{i}]", own, 1) >= 0):
            raise ValueError(f"weights[{i}] must not be negative; give 0 for points that are to be left out.")
