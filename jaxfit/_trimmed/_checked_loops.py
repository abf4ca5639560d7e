"""Checks of loops: closed polylines in (u, v) that bound a region."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit._trimmed._inside import Edges, inside_on_host

Loop = Float[np.ndarray, "_ 2"]

_ROUNDING = 1e-9  # of the width of the domain, by which vertices may lie outside; of 1, of a sine


def checked_loops(loops: Sequence[Any], domain: Float[np.ndarray, "2 2"]) -> list[Loop]:
    """The loops, moved into the domain by rounding, the first counter-clockwise and the others clockwise.

    `domain` holds the first and last u, and the first and last v.

    Raises
    ------
    ValueError
        If a loop is not finite, leaves the domain, or touches itself or another, or if a hole is not inside
        the first loop or is inside another hole.
    """
    inside = [_in_the_domain(_name(i), loop, domain) for i, loop in enumerate(loops)]
    check_simple(inside)
    turned = [_turned(_name(i), loop, counter_clockwise=not i) for i, loop in enumerate(inside)]
    _check_holes(turned)
    return turned


def edges_of(loops: Sequence[Loop]) -> Edges:
    """Start and end of every edge, the last of each loop back to its first vertex."""
    return np.concatenate([np.stack([loop, np.roll(loop, -1, axis=0)], axis=1) for loop in loops])


def signed_area(loop: Loop) -> float:
    """The area of a closed polyline, positive if it runs counter-clockwise."""
    x, y = (loop - loop.mean(axis=0)).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _name(i: int) -> str:
    return f"loops[{i}]"


def _in_the_domain(name: str, loop: Any, domain: Float[np.ndarray, "2 2"]) -> Loop:
    values = np.asarray(loop, float)
    if values.ndim == 2 and len(values) > 1 and np.array_equal(values[0], values[-1]):
        values = values[:-1]  # a ring as GeoJSON has it
    if values.ndim != 2 or values.shape[1] != 2 or len(values) < 3:
        raise ValueError(
            f"{name} must have shape (vertices, 2) with at least three vertices, but has shape "
            f"{values.shape}; give the parameters (u, v) of a closed polyline."
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite, but holds NaN or infinity; remove those vertices.")
    low, high = domain.T
    outside = np.maximum(low - values, values - high).max(axis=1)
    if (outside > _ROUNDING * (high - low).max()).any():
        at = "({:.6g}, {:.6g})".format(*values[int(np.argmax(outside))])
        raise ValueError(
            f"{name} must lie in the domain of the surface, [{low[0]:g}, {high[0]:g}] x [{low[1]:g}, "
            f"{high[1]:g}], but has the vertex {at}; clip it to the domain or extend the surface."
        )
    values = np.clip(values, low, high)
    apart = np.abs(values - np.roll(values, -1, axis=0)).max(axis=1)
    repeated = np.flatnonzero(apart <= 4 * np.finfo(values.dtype).eps * (high - low).max())
    if repeated.size:
        i = int(repeated[0])
        raise ValueError(
            f"{name} must not repeat a vertex, but vertices {i} and {(i + 1) % len(values)} are the same; "
            "remove one (a loop closes by itself)."
        )
    return values


def _turned(name: str, loop: Loop, counter_clockwise: bool) -> Loop:
    area = signed_area(loop)
    if area == 0:
        raise ValueError(f"{name} must enclose an area, but encloses none; give more vertices.")
    return loop if (area > 0) == counter_clockwise else loop[::-1]


def check_simple(loops: Sequence[Loop]) -> None:
    """Raise if two edges have a point in common that is not the vertex between neighbours."""
    edges = edges_of(loops)
    counts = np.array([len(loop) for loop in loops])
    of_loop = np.repeat(np.arange(len(loops)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    following = first + (np.arange(len(edges)) - first + 1) % counts[of_loop]
    i, j = _close_pairs(edges)
    neighbours = (following[i] == j) | (following[j] == i)
    met = np.where(neighbours, _fold_back(edges, i, j, following), _meet(edges[i], edges[j]))
    if not met.any():
        return
    k = int(np.argmax(met))
    a, b = int(of_loop[i[k]]), int(of_loop[j[k]])
    at = "({:.6g}, {:.6g})".format(*_common_point(edges[i[k]], edges[j[k]]))
    if a == b:
        raise ValueError(
            f"{_name(a)} must not touch or cross itself, but does near {at}; resample or repair it."
        )
    raise ValueError(
        f"loops must not touch or cross each other, but {_name(a)} and {_name(b)} do near {at}; join the two "
        "or shrink one."
    )


def _close_pairs(edges: Edges) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Pairs of edges whose bounding boxes overlap, by a sweep along u."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    order = np.argsort(low[:, 0], kind="stable")
    last = np.searchsorted(low[order, 0], high[order, 0], side="right")
    counts = last - np.arange(len(order)) - 1
    first = np.repeat(np.arange(len(order)), counts)
    second = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts) + first + 1
    i, j = order[first], order[second]
    overlap = (low[i, 1] <= high[j, 1]) & (low[j, 1] <= high[i, 1])
    return i[overlap], j[overlap]


def _meet(p: Edges, q: Edges) -> Bool[np.ndarray, " pairs"]:
    """Whether two segments, whose bounding boxes overlap, have a point in common."""
    sides = [
        np.sign(_cross(s[:, 1] - s[:, 0], t[:, k] - s[:, 0])) for s, t in ((p, q), (q, p)) for k in (0, 1)
    ]
    return (sides[0] * sides[1] <= 0) & (sides[2] * sides[3] <= 0)


def _common_point(p: Float[np.ndarray, "2 2"], q: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2"]:
    """Where two segments that meet do so: of parallel ones where what they share begins."""
    along, other = (np.diff(x, axis=0) for x in (p, q))
    across = _cross(along, other)[0]
    if abs(across) > _ROUNDING * np.linalg.norm(along) * np.linalg.norm(other):
        return p[0] + _cross(q[:1] - p[:1], other)[0] / across * along[0]
    return sorted((*p, *q), key=lambda end: float(end @ along[0]))[1]


def _fold_back(edges: Edges, i: Any, j: Any, following: Any) -> Bool[np.ndarray, " pairs"]:
    """Whether an edge runs back along the one before it."""
    before, after = np.where(following[i] == j, i, j), np.where(following[i] == j, j, i)
    along, back = (edges[k, 1] - edges[k, 0] for k in (before, after))
    return (_cross(along, back) == 0) & (np.sum(along * back, axis=1) < 0)


def _cross(a: Float[np.ndarray, "k 2"], b: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _check_holes(loops: Sequence[Loop]) -> None:
    """Raise unless each hole is inside the outer loop and outside the other holes; loops do not touch."""
    outer, *holes = loops
    for i, hole in enumerate(holes, start=1):
        if not inside_on_host(edges_of([outer]), hole[:1])[0]:
            raise ValueError(
                f"loops must begin with the outer one, but {_name(i)} is not inside {_name(0)}; put the "
                "outer loop first, and make a surface of its own for each further piece."
            )
        for j, other in enumerate(holes, start=1):
            if i != j and inside_on_host(edges_of([other]), hole[:1])[0]:
                raise ValueError(
                    f"loops must hold holes side by side, but {_name(i)} is inside {_name(j)}; leave it out "
                    "or make a surface of its own of that island."
                )
