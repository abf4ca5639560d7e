"""Knot vectors: uniform, from parameters, their Greville abscissae, and their union."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxfit._checks import as_floating, is_concrete
from jaxfit._splines._lookup import windows


def clamped_uniform_knots(
    count: int, order: int, domain: tuple[ArrayLike, ArrayLike] = (0.0, 1.0)
) -> Float[Array, " knots"]:
    """Clamped knot vector with equally long spans.

    Parameters
    ----------
    count : int
        Number of control points, at least `order`.
    order : int
        Degree + 1, at least 1.
    domain : array (2,)
        Start and stop (default 0 and 1), repeated `order` times each at the two ends.

    Raises
    ------
    ValueError
        If there are fewer control points than the order, or the domain is empty.

    Examples
    --------
    Two spans of a cubic:

    >>> print(jf.clamped_uniform_knots(5, 4))
    [0.  0.  0.  0.  0.5 1.  1.  1.  1. ]
    """
    _check_count("count", count, order)
    xp: Any = np if is_concrete(domain) else jnp
    start, stop = (xp.asarray(x, jnp.result_type(float, x)) for x in domain)
    if is_concrete(start, stop) and not start < stop:
        raise ValueError(
            f"domain must increase, but runs from {float(start):g} to {float(stop):g}; "
            "give (start, stop) with start below stop."
        )
    spans = count - order + 1
    inside = start + (stop - start) * (np.arange(1, spans) / spans)
    return jnp.asarray(_clamped(start, inside, stop, order))


def averaging_knots(parameters: ArrayLike, order: int) -> Float[Array, " knots"]:
    r"""Clamped knots that follow the density of interpolation parameters.

    Equation (5) of the paper (NURBS Book, equation 9.8): each interior knot is the mean of
    $K - 1$ consecutive parameters, $u_{K-1+k} = \frac{1}{K-1} \sum_{i=k}^{k+K-2} \tilde u_i$.
    Every basis function then has a parameter inside its support, so that the collocation matrix
    of strictly increasing parameters is invertible (Schoenberg-Whitney).

    Parameters
    ----------
    parameters : array (n,)
        Increasing, at least `order` of them. Their ends become the ends of the domain.
    order : int
        Degree + 1, at least 2.

    Returns
    -------
    array (n + order,)

    Raises
    ------
    ValueError
        If there are fewer parameters than the order, the order is below 2, or the parameters
        decrease somewhere.

    Examples
    --------
    >>> print(np.round(jf.averaging_knots(np.array([0.0, 0.1, 0.2, 0.6, 1.0]), 4), 3))
    [0.  0.  0.  0.  0.3 1.  1.  1.  1. ]
    """
    values = as_floating("parameters", parameters, 1)
    count = values.shape[0]
    if order < 2:
        raise ValueError(f"order must be at least 2 (linear), but is {order}; raise it.")
    _check_count("parameters", count, order)
    if is_concrete(values):
        falls = np.flatnonzero(np.diff(np.asarray(values)) < 0)
        if falls.size:
            raise ValueError(
                f"parameters must not decrease, but parameters[{falls[0] + 1}] is smaller than "
                "the one before it; sort them."
            )
    return _on_host(knots_by_averaging, values, order)


def knots_by_averaging(parameters: Any, order: int) -> Any:
    """`averaging_knots` of checked parameters, NumPy or JAX."""
    inside = _running_mean(parameters, order - 1)[: parameters.shape[0] - order]
    return _clamped(parameters[0], inside, parameters[-1], order)


def greville_abscissae(knots: ArrayLike, order: int) -> Float[Array, " n"]:
    r"""Greville abscissae $\xi_j = (t_{j+1} + \dots + t_{j+K-1}) / (K-1)$, one per control point.

    With control points $\xi_j$ a spline is the identity, $\sum_j \xi_j N_{j,K}(u) = u$; they are
    therefore the parameters "at" which control points sit. The ends of a clamped knot vector
    are met exactly.

    Parameters
    ----------
    knots : array (count + order,)
    order : int
        Degree + 1, at least 2.

    Returns
    -------
    array (count,)

    Raises
    ------
    ValueError
        If the order is below 2 or not below the number of knots.

    Notes
    -----
    Source: C. de Boor, A Practical Guide to Splines, revised edition (2001), chapter IX.

    Examples
    --------
    >>> [round(float(x), 3) for x in jf.greville_abscissae(jf.clamped_uniform_knots(5, 4), 4)]
    [0.0, 0.167, 0.5, 0.833, 1.0]
    """
    values = as_floating("knots", knots, 1)
    if not 2 <= order < values.shape[0]:
        raise ValueError(
            f"order must lie between 2 and the number of knots {values.shape[0]} less one, "
            f"but is {order}; pass the order the knots were made for."
        )
    return _on_host(greville, values, order)


def merge_knots(a: ArrayLike, b: ArrayLike, order: int, tolerance: float = 0.0) -> Float[Array, " knots"]:
    """Union of two knot vectors, each knot as often as in the vector that has it more often.

    Splines on `a` and on `b` are both splines on the result (section 2.3 of the paper). Concrete NumPy
    work: not for use under `jit`.

    Parameters
    ----------
    a, b : arrays (n_a,), (n_b,)
        Knot vectors of the same order on the same domain.
    order : int
        Degree + 1.
    tolerance : float, default 0
        Knots of `b` this close to one of `a` (in the units of the knots) count as that knot of
        `a`, so that rounding does not breed slivers of spans. What is snapped is exact no
        longer: refine the spline on `b` with its own values, then exchange its knots for the
        result, which moves it by about `tolerance` times its speed.

    Raises
    ------
    ValueError
        If a vector decreases, or the two domains differ by more than `tolerance`.
    TypeError
        If a vector is traced: the length of the result depends on the values.

    Examples
    --------
    >>> a, b = np.array([0.0, 0.0, 0.5, 1.0, 1.0]), np.array([0.0, 0.0, 0.25, 0.5, 0.5, 1.0, 1.0])
    >>> print(jf.merge_knots(a, b, 2))
    [0.   0.   0.25 0.5  0.5  1.   1.  ]
    """
    if not is_concrete(a, b):
        raise TypeError("merge_knots needs concrete knots, but was traced; call it outside jit.")
    a, b = _sorted_values("a", a), _sorted_values("b", b)
    for at in (order - 1, -order):
        if abs(a[at] - b[at]) > tolerance:
            raise ValueError(
                f"a and b must share one domain, but one ends at {a[at]:g} and the other at "
                f"{b[at]:g}; map one of them onto the other's domain."
            )
    b = _snapped(b, a, tolerance)
    values = np.union1d(a, b)
    repeats = np.maximum(*(np.array([np.sum(x == value) for value in values]) for x in (a, b)))
    return jnp.asarray(np.repeat(values, repeats))


def _snapped(knots: np.ndarray, onto: np.ndarray, tolerance: float) -> np.ndarray:
    nearest = onto[np.argmin(np.abs(knots[:, None] - onto[None, :]), axis=1)]
    return np.sort(np.where(np.abs(knots - nearest) <= tolerance, nearest, knots))


def _sorted_values(name: str, knots: ArrayLike) -> np.ndarray:
    values = np.asarray(as_floating(name, knots, 1))
    if (np.diff(values) < 0).any():
        raise ValueError(f"{name} must not decrease, but does; sort the knots.")
    return values


def greville(knots: Any, order: int) -> Any:
    """`greville_abscissae` of checked knots, NumPy or JAX."""
    return _running_mean(knots, order - 1)[: knots.shape[0] - order]


def _on_host(function: Callable[[Any, int], Any], values: Any, order: int) -> Array:
    """`function(values, order)`, by NumPy unless traced: every new length would compile anew."""
    if not is_concrete(values):
        return function(values, order)
    return jnp.asarray(function(np.asarray(values, np.float64), order).astype(values.dtype))


def _running_mean(values: Any, width: int) -> Any:
    """Means of `width` consecutive values, from the second value on."""
    runs = windows(values, np.arange(1, values.shape[0] - width + 1), width)
    # Measured from the first one, so that the mean of equal knots is that knot to the last bit.
    return runs[0] + (runs - runs[:1]).sum(0) / width


def _clamped(start: Any, inside: Any, stop: Any, order: int) -> Any:
    xp: Any = np if is_concrete(start, inside, stop) else jnp
    ends = [xp.broadcast_to(x, (order,)) for x in (start, stop)]
    return xp.concatenate([ends[0], inside.astype(ends[0].dtype), ends[1]])


def _check_count(name: str, count: int, order: int) -> None:
    if order < 1 or count < order:
        raise ValueError(
            f"{name} must be at least the order {order} (itself at least 1), but there are "
            f"{count}; give more or lower the order."
        )
