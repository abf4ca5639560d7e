r"""Quadrature over the region inside loops, exact for its shape.

With $F(u, v) = \int_{u_0}^u f(s, v)\, ds$, Green's theorem makes $\int_D f\, du\, dv = \oint_{\partial D} F\,
dv$. Everything to the left of the cell in which a piece of a loop runs is taken together as rectangles of
whole cells, and Gauss's rule is applied to integrands that are smooth.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfit._trimmed._checked_loops import Edges

_NODES = 8  # of Gauss's rule along each direction of a rectangle


class Nodes(NamedTuple):
    """Parameters and weights, so that sum(weight * f(u, v)) is the integral of f."""

    u: Float[np.ndarray, " nodes"]
    v: Float[np.ndarray, " nodes"]
    weight: Float[np.ndarray, " nodes"]


def quadrature(
    edges: Edges, breaks_u: Float[np.ndarray, " a"], breaks_v: Float[np.ndarray, " b"], count: int = _NODES
) -> Nodes:
    """Nodes for functions that are smooth in each cell of the distinct knots `breaks_u` and `breaks_v`."""
    rule = np.polynomial.legendre.leggauss(count)
    parts = _whole_widths(edges, breaks_u, breaks_v, rule), _beside_the_loops(edges, breaks_u, breaks_v, rule)
    return Nodes(*(np.concatenate(pair) for pair in zip(*parts, strict=True)))


def _whole_widths(edges: Edges, breaks_u: np.ndarray, breaks_v: np.ndarray, rule: tuple) -> Nodes:
    """Cells to the left of points inside: each over those heights at which its right side is inside."""
    node, weight = 0.5 * (1 + rule[0]), 0.5 * rule[1]
    u, v, w = ([np.zeros(0)] for _ in range(3))
    # Nothing is to the right of the last column.
    for low, high in pairwise(breaks_u[:-1]):
        starts, ends = _inside_on_line(edges, high, breaks_v)
        width, heights = high - low, (ends - starts)[:, None]
        at = starts[:, None] + heights * node
        shape = (len(starts), len(node), len(node))
        u.append(np.broadcast_to((low + width * node)[None, :, None], shape).reshape(-1))
        v.append(np.broadcast_to(at[:, None, :], shape).reshape(-1))
        w.append((width * weight[:, None] * (heights * weight)[:, None, :]).reshape(-1))
    return Nodes(*map(np.concatenate, (u, v, w)))


def _inside_on_line(
    edges: Edges, at: float, breaks: Float[np.ndarray, " b"]
) -> tuple[Float[np.ndarray, " pieces"], Float[np.ndarray, " pieces"]]:
    """Intervals of v that are inside just to the left of u = `at`, cut at `breaks`."""
    start, end = edges[:, 0], edges[:, 1]
    crossing = (start[:, 0] < at) != (end[:, 0] < at)
    start, end = start[crossing], end[crossing]
    share = (at - start[:, 0]) / (end[:, 0] - start[:, 0])
    heights = np.sort(start[:, 1] + share * (end[:, 1] - start[:, 1]))
    cuts = np.unique(np.concatenate([breaks, heights]))
    inside = np.searchsorted(heights, 0.5 * (cuts[:-1] + cuts[1:])) % 2 == 1
    return cuts[:-1][inside], cuts[1:][inside]


def _beside_the_loops(edges: Edges, breaks_u: np.ndarray, breaks_v: np.ndarray, rule: tuple) -> Nodes:
    """What lies between a piece of a loop and the left side of its cell; negative where the loop descends."""
    node, weight = 0.5 * (1 + rule[0]), 0.5 * rule[1]
    start, end = cut_at_lines(edges, breaks_u, breaks_v)
    cell = _interval_of(0.5 * (start[:, 0] + end[:, 0]), breaks_u)
    along = start[:, None, :] + (end - start)[:, None, :] * node[:, None]
    left = breaks_u[cell][:, None]
    width = along[..., 0] - left
    u = left[..., None] + width[..., None] * node
    v = np.broadcast_to(along[..., 1, None], u.shape)
    rise = (end[:, 1] - start[:, 1])[:, None] * weight
    return Nodes(u.reshape(-1), v.reshape(-1), ((rise * width)[..., None] * weight).reshape(-1))


def cut_at_lines(
    edges: Edges, lines_u: Float[np.ndarray, " a"], lines_v: Float[np.ndarray, " b"]
) -> tuple[Float[np.ndarray, "pieces 2"], Float[np.ndarray, "pieces 2"]]:
    """Starts and ends of the pieces of edges between lines of constant u and of constant v, in order."""
    i, a, b = _pieces(edges, lines_u, lines_v)
    start, along = edges[i, 0], edges[i, 1] - edges[i, 0]
    ends = np.where((b == 1)[:, None], edges[i, 1], start + b[:, None] * along)
    return start + a[:, None] * along, ends


def along_edges(
    edges: Edges, lines_u: Float[np.ndarray, " a"], lines_v: Float[np.ndarray, " b"], count: int = _NODES
) -> tuple[
    Int[np.ndarray, " nodes"],
    Float[np.ndarray, " nodes"],
    Float[np.ndarray, "nodes 2"],
    Float[np.ndarray, " nodes"],
]:
    """Nodes of Gauss's rule on the same pieces: edge, share of it, place, and weight; 1 for a whole edge."""
    node, weight = np.polynomial.legendre.leggauss(count)
    i, a, b = _pieces(edges, lines_u, lines_v)
    owner = np.repeat(i, count)
    share = (a[:, None] + (b - a)[:, None] * 0.5 * (1 + node)).reshape(-1)
    places = edges[owner, 0] + share[:, None] * (edges[owner, 1] - edges[owner, 0])
    return owner, share, places, ((b - a)[:, None] * 0.5 * weight).reshape(-1)


def _pieces(
    edges: Edges, lines_u: np.ndarray, lines_v: np.ndarray
) -> tuple[Int[np.ndarray, " pieces"], Float[np.ndarray, " pieces"], Float[np.ndarray, " pieces"]]:
    """Edge, and first and last share of it, of each piece between lines."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    owners, shares = [np.arange(len(edges))] * 2, [np.zeros(len(edges)), np.ones(len(edges))]
    for axis, lines in enumerate((lines_u, lines_v)):
        low, high = np.sort(edges[:, :, axis], axis=1).T
        first = np.searchsorted(lines, low, side="right")
        counts = np.maximum(np.searchsorted(lines, high, side="left") - first, 0)
        owner = np.repeat(np.arange(len(edges)), counts)
        line = lines[np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts - first, counts)]
        owners.append(owner)
        shares.append((line - start[owner, axis]) / along[owner, axis])
    owner, share = np.concatenate(owners), np.concatenate(shares)
    order = np.lexsort((share, owner))
    owner, share = owner[order], share[order]
    same = (owner[1:] == owner[:-1]) & (share[1:] > share[:-1])
    return owner[1:][same], share[:-1][same], share[1:][same]


def _interval_of(x: Float[np.ndarray, " k"], breaks: Float[np.ndarray, " b"]) -> Int[np.ndarray, " k"]:
    return np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2)
