"""Checks of what users hand in: one sentence each, before anything is compiled."""

import operator
import os
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

# A number that may be traced.
Scalar = float | np.ndarray | jax.Array

LARGEST = 1e150
LARGEST_COUNT = 2**31 - 2
LEAST_ORDER, MOST_ORDER = 2, 8
# Between which the coordinates of a cloud can choose, along its diagonal.
LEAST_STEPS = {np.dtype(np.float64): 1e4, np.dtype(np.float32): 1e3}
_INSTEAD = {  # of None
    "points": "where data.points of a file is None, pass data itself, or data.grid.reshape(-1, 3)",
    "grid": "where data.grid of a file is None, pass data.as_grid(n, m), or fit data by fit_points",
}


def is_concrete(*trees: Any) -> bool:
    """Whether no leaf of `trees` is a tracer, so that values may be looked at."""
    for tree in trees:
        # Most are single arrays, for which the detour through a tree takes ten times as long.
        leaves = (tree,) if isinstance(tree, (np.ndarray, jax.Array)) else jax.tree_util.tree_leaves(tree)
        if any(isinstance(x, jax.core.Tracer) for x in leaves):
            return False
    return True


def without_derivatives(tree: Any) -> Any:
    """The tree with `stop_gradient` of its tracers; the rest is left as it is."""

    def value(x: Any) -> Any:
        x = _without_tangents(x)
        return jax.lax.stop_gradient(x) if isinstance(x, jax.core.Tracer) else x

    return jax.tree.map(value, tree)


def _without_tangents(x: Any) -> Any:
    """An array without the tangents that `grad` gives it: under `grad` alone its numbers. Traces nothing."""
    while isinstance(x, jax.core.Tracer) and hasattr(x, "primal"):
        x = x.primal
    return x


def eager_where_concrete(function: Callable[..., Any]) -> Callable[..., Any]:
    """Have `function` computed at once, even while something around it is traced, if none of its arguments
    is: inside `jit` JAX would otherwise trace what depends on constants only.
    """

    @wraps(function)
    def at_once(*args: Any, **options: Any) -> Any:
        if not is_concrete(args, options):
            return function(*args, **options)
        with jax.core.eval_context():
            return function(*args, **options)

    return at_once


def said_missing(path: str | os.PathLike) -> str:
    """The sentence for a file that is not there."""
    return f"{os.fspath(path)} does not exist; check its name and folder."


def as_floating(name: str, x: ArrayLike, ndim: int) -> Any:
    """`x` as a floating array with `ndim` dimensions; NumPy stays NumPy, so that nothing compiles."""
    array: Any = x
    if x is None:
        raise TypeError(f"{name} must be an array, but is None; {_INSTEAD.get(name, 'pass one')}.")
    if isinstance(x, str | os.PathLike):
        raise TypeError(
            f"{name} must be an array, but is {os.fspath(x)!r}; read a file by jaxfit.io.read_points."
        )
    if hasattr(x, "cloud") and hasattr(x, "grid"):
        raise TypeError(f"{name} must be an array, but is a {type(x).__name__}; pass its .cloud or .grid.")
    if isinstance(array, np.ma.MaskedArray):
        array = unmasked(name, array)
    if not isinstance(array, (np.ndarray, jax.Array)):
        try:
            array = np.asarray(array)
        except ValueError as error:
            raise ValueError(
                f"{name} must be a rectangular array of numbers, but its rows differ in length; "
                "make them equal."
            ) from error
    if array.dtype.kind not in "fiub" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(f"{name} must hold real numbers, but has dtype {array.dtype}; convert it to floats.")
    if array.ndim != ndim:
        raise ValueError(
            f"{name} must have {ndim} dimension{'s' * (ndim != 1)}, but has shape {array.shape}; "
            f"{_as_wanted(name, array.shape, ndim)}."
        )
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(np.float64 if isinstance(array, np.ndarray) else jnp.result_type(float))
    elif not array.dtype.isnative:  # JAX takes no other order of bytes
        array = array.astype(array.dtype.newbyteorder("="))
    known = _without_tangents(array)
    if is_concrete(known) and array.size:
        check_finite(name, known)
    return array


def _as_wanted(name: str, shape: tuple[int, ...], ndim: int) -> str:
    """What to do with an array whose number of dimensions is wrong: grids and clouds are often mixed up."""
    if len(shape) == 3 and ndim == 2:
        if has_coordinates_first(shape):
            turned = f"np.moveaxis({name}, 0, -1)"
            return f"pass {name}.reshape({shape[0]}, -1).T, or interpolate {turned} if it is a grid of data"
        return f"pass {name}.reshape(-1, {shape[2]}), or interpolate it if it is a grid of data"
    if len(shape) == 2 and ndim == 3 and name == "grid":
        return "reshape it to (n, m, d) if its points stand row by row, or fit them by fit_points as a cloud"
    if len(shape) == 1 and ndim == 2 and name == "points":
        return "give one row per point, a single one as points[None]"
    return "reshape it"


def has_coordinates_first(shape: tuple[int, ...]) -> bool:
    """Whether an array (n, m, d) has the shape of a grid whose coordinates were stacked along axis 0."""
    return shape[0] in (2, 3) and shape[2] > 3


def unmasked(name: str, x: np.ma.MaskedArray) -> np.ndarray:
    """The values of a masked array; raises if any is masked, for a fit would take it as data."""
    count = int(np.ma.count_masked(x))
    if count:
        raise ValueError(
            f"{name} must not be masked, but {count} of its {x.size} entries are; leave out those points, or "
            "fill them."
        )
    return np.ma.getdata(x)


def as_vector(name: str, x: ArrayLike | Sequence[float | int], dimension: int | None = None) -> Any:
    """`x` as a floating vector (d,), of `dimension` coordinates where that is given."""
    entries: Any = np.asarray(x) if isinstance(x, (list, tuple)) else x
    vector = as_floating(name, entries, 1)
    if dimension is not None and vector.shape != (dimension,):
        raise ValueError(
            f"{name} must have {dimension} coordinates, but has shape {vector.shape}; give a vector."
        )
    return vector


def as_direction(name: str, x: ArrayLike | Sequence[float | int], dimension: int | None = None) -> Any:
    """`as_vector`, not zero where it is concrete."""
    vector = as_vector(name, x, dimension)
    if is_concrete(vector) and not np.any(vector):
        raise ValueError(f"{name} must not be zero, since it then has no direction; give a vector.")
    return vector


def check_finite(name: str, x: ArrayLike) -> None:
    """Raise unless every entry of the concrete array `x` is finite."""
    values = np.asarray(x)
    if np.isfinite(values).all():
        return
    bad = ~np.isfinite(values)
    first = tuple(int(i) for i in np.argwhere(bad)[0])
    where = first[0] if len(first) == 1 else first
    raise ValueError(
        f"{name} must be finite, but {int(bad.sum())} of its {values.size} entries are NaN or "
        f"infinite, the first at index {where}; remove or repair them."
    )


def check_magnitude(name: str, x: ArrayLike) -> None:
    """Raise unless squares of the concrete array `x` stay within the range of float64."""
    values = np.asarray(x)
    if values.size and values.dtype.itemsize >= 8 and max(values.max(), -values.min()) > LARGEST:
        raise ValueError(
            f"{name} must be at most {LARGEST:g} in magnitude, so that squares stay within the range of "
            "float64; scale it down."
        )


def check_resolution(name: str, low: np.ndarray, high: np.ndarray, diagonal: float, dtype: Any) -> None:
    """Raise if points in the box from `low` to `high` are so far from the origin that their `dtype` blurs
    them."""
    dtype = dtype if dtype in LEAST_STEPS else np.dtype(np.float64)
    steps = diagonal / (float(np.finfo(dtype).eps) * max(-low.min(), high.max()))
    if steps < LEAST_STEPS[dtype]:
        raise ValueError(
            f"{name} must differ by more than the rounding of their coordinates, but the diagonal of their "
            f"bounding box is only {steps:.3g} units of it; subtract their centre before they are rounded."
        )


def as_points(name: str, x: ArrayLike, dimension: int | None = None, least: int = 1) -> Any:
    """`x` as a floating array (points, d) of at least `least` points."""
    array = as_floating(name, x, 2)
    if dimension is not None and array.shape[1] != dimension:
        turned = f"pass {name}.T" if array.shape[0] == dimension else "give one row per point"
        raise ValueError(
            f"{name} must have {dimension} coordinates a row, but has {array.shape[1]}; {turned}."
        )
    if array.shape[1] < 1 or array.shape[0] < least:
        raise ValueError(
            f"{name} must hold at least {least} point{'s' * (least != 1)}, but has shape "
            f"{array.shape}; give more points."
        )
    known = _without_tangents(array)
    if is_concrete(known):
        check_magnitude(name, known)
    return array


def check_knots(name: str, knots: ArrayLike, order: int, count: int) -> None:
    """Raise unless `knots` is a knot vector for `count` control points of this order."""
    if not is_concrete(knots):
        return
    values = np.asarray(knots)
    falls = np.flatnonzero(np.diff(values) < 0)
    if falls.size:
        i = int(falls[0])
        raise ValueError(
            f"{name} must not decrease, but {name}[{i + 1}] = {values[i + 1]:g} comes after "
            f"{values[i]:g}; sort the knots."
        )
    if not values[order - 1] < values[count]:
        raise ValueError(
            f"{name} must span a domain, but its ends {values[order - 1]:g} and "
            f"{values[count]:g} coincide; spread the knots."
        )
    _check_multiplicity(name, values, order, count)


def _check_multiplicity(name: str, knots: np.ndarray, order: int, count: int) -> None:
    # Extra repeats of the end knots are harmless (they pad nets of fixed capacity).
    inside = (knots > knots[order - 1]) & (knots < knots[count])
    values, repeats = np.unique(knots[inside], return_counts=True)
    if repeats.size and repeats.max() > order:
        i = int(np.argmax(repeats))
        raise ValueError(
            f"{name} must repeat no interior knot more than {order} times (the order), but "
            f"{values[i]:g} appears {repeats[i]} times; remove the surplus."
        )


def check_kind(name: str, value: Any, kind: Any, example: str) -> None:
    """Raise unless `value` is an instance of `kind`; `example` says what to pass, one or several."""
    if not isinstance(value, kind):
        given = f"the string {value!r}" if isinstance(value, str) else f"a {type(value).__name__}"
        if isinstance(value, type):
            given = f"the class {value.__name__}"
            example = f"{value.__name__}()" if issubclass(value, kind) else example
        wanted = "one of these" if " or " in example else example
        raise TypeError(f"{name} must be an object such as {example}, but is {given}; pass {wanted}.")


def check_switches(owner: Any, names: tuple[str, ...]) -> None:
    """Fields that are True or False and nothing else."""
    for name in names:
        check_switch(name, getattr(owner, name))


def check_switch(name: str, value: Any) -> None:
    """Raise unless `value` is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False, but is {value!r}; pass either.")


def check_progress(value: Any) -> None:
    """Raise unless `value` is None or may be called, as the `progress` of a fit is."""
    if value is not None and not callable(value):
        raise TypeError(
            f"progress must be callable, but is {value!r}; pass a function of (step, max_steps, average, "
            "maximum)."
        )


def check_number(name: str, value: Any, least: int | float, whole: bool = False) -> None:
    """Raise unless a concrete `value` is one finite number, at least `least`, and if so asked `whole`: no
    float, and no larger than numbers of 32 bits. True and False are no numbers."""
    if not is_concrete(value):
        return
    kind = "a whole number" if whole else "a number"
    try:
        if isinstance(value, (str, bytes)) or np.ndim(value) or np.asarray(value).dtype.kind == "b":
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise TypeError(f"{name} must be {kind}, but is {value!r}; pass {kind}.") from error
    if number == np.inf:
        raise ValueError(f"{name} must be finite, but is {number:g}; lower it.")
    if np.isnan(number) or (whole and not _is_index(value)):
        raise ValueError(f"{name} must be {kind} of at least {least:g}, but is {value!r}; pass {kind}.")
    if whole and number > LARGEST_COUNT:
        raise ValueError(f"{name} must be at most {LARGEST_COUNT}, but is {number:g}; lower it.")
    if number < least:
        raise ValueError(f"{name} must be {kind} of at least {least:g}, but is {number:g}; raise it.")


def _is_index(value: Any) -> bool:
    """Whether a number is an integer by its type, as `range` and shapes ask for."""
    try:
        operator.index(value)
    except TypeError:
        return False
    return True


def check_steps(name: str, value: Any) -> None:
    """Raise unless `value` is a whole number of steps, known before tracing: histories have room for it."""
    if not is_concrete(value):
        raise TypeError(f"{name} must be known before tracing, but is traced; pass an int.")
    check_number(name, value, 0, whole=True)


def with_whole_steps(options: dict[str, Any]) -> dict[str, Any]:
    """The options, `max_steps` as an int where it is a whole number of some other type, for it is hashed."""
    steps: Any = options.get("max_steps")
    if not is_concrete(steps) or np.ndim(steps) or not np.issubdtype(np.asarray(steps).dtype, np.integer):
        return options
    return options | {"max_steps": int(steps)}


def checked_order(order: Any) -> tuple[int, int]:
    """`order` as a pair, whose numbers are equal where one is given; raises unless they are from 2 to 8."""
    pair = (order, order) if isinstance(order, (int, np.integer)) else order
    whole = isinstance(pair, (tuple, list)) and all(isinstance(k, (int, np.integer)) for k in pair)
    if not whole or len(pair) != 2 or not all(LEAST_ORDER <= k <= MOST_ORDER for k in pair):
        raise ValueError(
            f"order must be a whole number from {LEAST_ORDER} to {MOST_ORDER}, or a pair (K, L) of them, but "
            f"is {order!r}; pass for instance 4 or (4, 3)."
        )
    return int(pair[0]), int(pair[1])
