"""Douglas-Peucker: the few vertices of a polyline that carry its shape."""

import heapq

import numpy as np

TIE = 1e-7  # of the whole length: smaller differences are rounding, and the first of several counts
FLAT_TOP = 1e-3  # at most, of the farthest distance: in a slight bend several are almost that far away


def chord_lengths(points: np.ndarray) -> np.ndarray:
    """Length of the polyline (n, d) up to each vertex, (n,), starting with 0."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def densify(points: np.ndarray, count: int) -> np.ndarray:
    """Cut the longest edges of the polyline into equal parts until it has `count` vertices."""
    edges = np.linalg.norm(np.diff(points, axis=0), axis=1)
    parts = np.ones(len(edges), int)
    for _ in range(count - len(points)):
        lengths = edges / parts
        parts[np.argmax(lengths >= (1 - TIE) * lengths.max())] += 1
    edge = np.repeat(np.arange(len(edges)), parts)
    part = np.arange(len(edge)) - np.repeat(np.cumsum(parts) - parts, parts)
    t = (part / parts[edge])[:, None]
    inner = (1 - t) * points[edge] + t * points[edge + 1]
    return np.concatenate([inner, points[-1:]])


def simplify(
    points: np.ndarray,
    tolerance: float,
    least: int = 2,
    most: int | None = None,
    spread: float = 0.0,
) -> np.ndarray:
    """Indices of the vertices that Douglas and Peucker keep, ascending.

    Starting from the two ends, the piece with the farthest vertex from its chord (a segment, so
    closed polylines work) is split there, until no vertex is farther away than `tolerance`: the
    same vertices as the usual recursion. At least `least` vertices are kept, no more than
    `most`, fewer than `least` only if `points` (n, d) has fewer. Pieces within the tolerance
    are split near their middle, the longest first, for along a nearly straight piece the
    farthest vertex is chance.

    With `spread` > 0 the next piece to split is the one with the greatest sum of that distance
    and `spread` times its length, so that a fixed number of vertices leaves no long gaps.

    Source: D. H. Douglas, T. K. Peucker, Cartographica 10 (1973). A heap instead of recursion:
    O(n) per kept vertex at worst, any depth.
    """
    arc = chord_lengths(points)
    kept = [0, len(points) - 1]
    grain = TIE * float(arc[-1]) or 1.0
    heap: list[tuple[int, int, int, int, int, bool]] = []

    def offer(i: int, j: int) -> None:
        if j - i > 1:
            length = float(arc[j] - arc[i])
            k, distance = _split(points, arc, i, j, tolerance, grain)
            first, then = (round(-x / grain) for x in (distance + spread * length, length))
            heapq.heappush(heap, (first, then, i, j, k, distance == 0.0))

    offer(*kept)
    while heap and (most is None or len(kept) < most):
        _, _, i, j, k, flat = heapq.heappop(heap)
        if flat and len(kept) >= least:
            break
        kept.append(k)
        offer(i, k)
        offer(k, j)
    return np.sort(kept)


def _split(
    points: np.ndarray, arc: np.ndarray, i: int, j: int, tolerance: float, grain: float
) -> tuple[int, float]:
    """Where to split the piece i..j, and its farthest distance, 0 if within the tolerance."""
    start, chord = points[i], points[j] - points[i]
    inner = points[i + 1 : j] - start
    square = float(chord @ chord)
    along = np.clip(inner @ chord / square, 0.0, 1.0) if square > 0 else np.zeros(len(inner))
    distances = np.linalg.norm(inner - along[:, None] * chord, axis=1)
    distance = float(distances.max())
    if distance > tolerance:
        return i + 1 + int(np.argmax(distances >= distance - min(grain, FLAT_TOP * distance))), distance
    off = np.abs(arc[i + 1 : j] - (arc[i] + arc[j]) / 2)
    return i + 1 + int(np.argmax(off <= off.min() + grain)), 0.0
