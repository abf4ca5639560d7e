"""Nearest feet of concrete points: padded to common sizes; searched for above the reach of the surface."""

from functools import cached_property, partial
from typing import Any

import jax
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._cells import values_at
from jaxfit._closest._candidates import Search
from jaxfit._closest._chunks import (
    CHUNK,
    HostFeet,
    chunk_size,
    in_chunks,
    neighbours_together,
    padded,
    places,
)
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._project import project
from jaxfit._closest._reach import POINTS_PER_SAMPLE, Reach, number_of_samples
from jaxfit._closest._samples import sample
from jaxfit._compile import compiled
from jaxfit._splines._pieces import Axis, Pieces, pieces_on

MOST_STARTS = 1 << 16  # tried at a time, for the memory's sake
# Where cells are few the reach costs little, and it spares searches that exchange feet for the same ones with
# other last digits.
LEAST_POINTS_PER_CELL = 24
SOME = 4  # points in a cell show whether there are nearer feet elsewhere
MUCH_NEARER = 0.999  # of a squared distance


def nearest_feet(
    method: AbstractFootMethod,
    net: Float[Any, "nu nv d"],
    axis_u: Axis,
    axis_v: Axis,
    points: Float[np.ndarray, "points d"],
    *,
    start: tuple[Any, Any] | None = None,
    known: tuple[Any, Any, Any, Any] | None = None,
    thorough: bool = True,
    tolerance: float,
    max_steps: int,
    used: tuple[int, int] | None = None,
    chunk: int | None = None,
) -> HostFeet:
    """Feet of all points: `u`, `v`, `distance`, `converged`, `steps`, and `point` on the surface.

    From `start`, a pair (u, v), the feet are local ones. Without it they are the nearest of all: in large
    clouds points whose foot is below the estimated reach of the surface are done, and the others are searched
    for. `known` are feet (u, v, distance, converged) found before, with which the search begins; `point` is
    then left out. If the search is not `thorough`, in large clouds only some points of each cell are searched
    for, and all where one of these has found a nearer foot. `tolerance` is a fraction of the extent. Of a net
    with surplus control points, behind repeated end knots, `used` says how many are in use along u and v.
    `chunk` is how many points are projected at a time; by default that depends on how many there are.
    """
    if chunk is None:
        chunk = chunk_size(len(points) if known is None else min(len(points), CHUNK))
    projector = _Projector(method, net, (axis_u, axis_v), points, tolerance, max_steps, chunk)
    if start is not None:
        best = dict(projector(None, *start))
    else:
        best = _globally(projector, known, used or net.shape[:2], thorough)
    lost = np.flatnonzero(~best["converged"])
    if lost.size:
        best = {name: np.array(x) for name, x in best.items()}
        take_nearer(best, lost, projector(lost, best["u"][lost], best["v"][lost], borders=True))
    with np.errstate(invalid="ignore"):
        best["distance"] = np.sqrt(best.pop("f")) * projector.unit
    if "point" in best:
        best["point"] = best["point"].T * projector.unit + projector.centre.astype(net.dtype)[None, :]
    return best


def compile_search_ahead(
    method: AbstractFootMethod, net: Any, axis_u: Axis, axis_v: Axis, count: int, chunk: int | None = None
) -> None:
    """Begin to compile what `nearest_feet` takes where the feet of so many points are known."""
    chunk = chunk or chunk_size(min(count, CHUNK))
    _Projector(method, net, (axis_u, axis_v), np.zeros((1, net.shape[2])), 0.0, 1, chunk).compile_ahead()


@partial(compiled, kept=True, static_argnums=(0, 1))
def _run(
    method: AbstractFootMethod,
    borders: bool,
    pieces: Pieces,
    target: Array,
    u: Array,
    v: Array,
    idle: Array,
    tolerance: Array,
    max_steps: Array,
) -> dict[str, Array]:
    """Local feet, also on the `borders`: few clouds have feet that need them, so that is another program."""
    feet = project(method, pieces, target, u, v, tolerance, max_steps, idle, borders)
    return {
        "u": feet.best_u,
        "v": feet.best_v,
        "f": feet.squared_distance,
        "converged": feet.converged,
        "steps": feet.steps,
        "point": values_at(pieces, feet.best_u, feet.best_v),
    }


class _Projector:
    """Local feet of some of the points from starts, always in the same shapes.

    Lengths are in a `unit`, a power of two near the extent: in single precision squares of very small or
    large numbers would be 0 or infinite.
    """

    def __init__(
        self,
        method: AbstractFootMethod,
        net: Any,
        axes: tuple[Axis, Axis],
        points: np.ndarray,
        tolerance: float,
        max_steps: int,
        size: int,
    ):
        self.method, self.axes, self.dtype, self.size = method, axes, np.dtype(net.dtype), size
        net = np.asarray(net, np.float64)
        self.centre = _middle(net)
        self.net = net - self.centre
        self.centred = np.empty(points.shape[::-1])
        np.subtract(points.T, self.centre[:, None], out=self.centred)
        box = _box(self.net, self.centred)
        self.unit = float(np.ldexp(1.0, np.frexp(box.max())[1] - 1)) if 0 < box.max() < np.inf else 1.0
        self.net /= self.unit
        self.centred /= self.unit
        extent = self.dtype.type(tolerance * np.linalg.norm(box / self.unit))
        self.limits = extent, np.int32(max_steps)

    @cached_property
    def pieces(self) -> Pieces:
        """The surface, made only if there is anything to project."""
        return jax.device_put(pieces_on(self.net.astype(self.dtype), *self.axes))

    def compile_ahead(self) -> None:
        """Begin to compile the program that the calls take, if that has not been done."""
        nothing = np.zeros((self.net.shape[2], self.size), self.dtype)
        idle = np.zeros(self.size, bool)
        _run.ahead(self.method, False, self.pieces, nothing, nothing[0], nothing[0], idle, *self.limits)

    def __call__(self, which: Any, u: Any, v: Any, borders: bool = False) -> HostFeet:
        """Feet of the points `which` (None: all) from (u, v)."""
        self.pieces  # noqa: B018 (before there are threads)
        chosen = self.centred if which is None else self.centred[:, which]
        one = partial(self._feet_of_chunk, borders)
        u, v = np.asarray(u), np.asarray(v)
        # A chunk of neighbours has fuller rows and stays in fewer cells.
        order = neighbours_together(self.axes, u, v) if u.size > self.size else None
        return in_chunks(one, (chosen, u, v), self.size, order)

    def _feet_of_chunk(self, borders: bool, *inputs: np.ndarray) -> dict[str, Array]:
        idle = np.arange(self.size) >= inputs[0].shape[-1]
        inputs = tuple(padded(x, self.size).astype(self.dtype, copy=False) for x in inputs)
        return _run(self.method, borders, self.pieces, *inputs, idle, *self.limits)


def _globally(projector: _Projector, known: Any, used: tuple[int, int], thorough: bool) -> HostFeet:
    """The nearest foot of all."""
    net = projector.net[: used[0], : used[1]]
    axes = [_in_use(axis, count) for axis, count in zip(projector.axes, used, strict=True)]
    points = projector.centred.T
    search = None
    if known is None:
        projector.compile_ahead()  # while SciPy's trees are imported and searched
        search = Search(sample(net.astype(projector.dtype), *axes))
        best = projector(None, *search.nearest(points))
        best = {name: np.array(x) for name, x in best.items()}
        left = np.arange(len(points))
    else:
        names = ("u", "v", "distance", "converged")
        best = {name: np.array(x) for name, x in zip(names, known, strict=True)}
        squares = (best.pop("distance") / projector.unit) ** 2
        best |= {"f": squares, "steps": np.zeros(len(points), np.int32)}
        left = np.flatnonzero(~best["converged"])
        if left.size:
            search = Search(sample(net.astype(projector.dtype), *axes))
            take_nearer(best, left, projector(left, *search.nearest(points[left])))
        left = np.arange(len(points))
    # The reach is that of a surface in space whose tangent plane nowhere jumps.
    smooth = not (axes[0].creased or axes[1].creased) and axes[1].polynomials.shape[1] > 1
    cells = axes[0].cells * axes[1].cells
    enough = min(POINTS_PER_SAMPLE * number_of_samples(*axes), LEAST_POINTS_PER_CELL * cells)
    if smooth and net.shape[2] == 3 and len(points) >= enough:
        below = Reach(net, *axes).exceeds(best["u"], best["v"], np.sqrt(best["f"]))
        left = np.flatnonzero(~(below & best["converged"]))
    if left.size:
        search = search or Search(sample(net.astype(projector.dtype), *axes))
        if not thorough:
            left = _where_some_have_nearer_feet(projector, search, left, best)
        _try_candidates(projector, search, left, best)
    return best


def _where_some_have_nearer_feet(
    projector: _Projector, search: Search, left: np.ndarray, best: HostFeet
) -> np.ndarray:
    """Search for SOME of the points `left` in each cell, and return the other points of cells where that has
    found much nearer feet, and of the cells around these. Where points are few all are returned.
    """
    axes = projector.axes
    cells = axes[0].cells, axes[1].cells
    every = left.size // (SOME * cells[0] * cells[1])
    if every < 2:
        return left
    place = places(axes, best["u"][left], best["v"][left])
    some = np.argsort(place, kind="stable")[::every]
    limit = MUCH_NEARER * best["f"][left[some]]
    _try_candidates(projector, search, left[some], best)
    row, column = np.divmod(place[some[best["f"][left[some]] < limit]], cells[1])
    around = np.zeros((cells[0] + 2, cells[1] + 2), bool)
    for i, j in np.ndindex(3, 3):
        around[row + i, column + j] = True
    chosen = around[1:-1, 1:-1].reshape(-1)[place]
    chosen[some] = False
    return left[chosen]


def _try_candidates(projector: _Projector, search: Search, left: np.ndarray, best: HostFeet) -> None:
    """Start from every sample that may lead to a nearer foot of the points `left`, if there are any."""
    if not left.size:
        return
    left = left[neighbours_together(projector.axes, best["u"][left], best["v"][left])]  # quicker in the tree
    distance = np.sqrt(best["f"][left].astype(np.float64))
    points = np.ascontiguousarray(projector.centred.T[left])
    candidates = search.candidates(points, best["u"][left], best["v"][left], distance)
    size = projector.size
    if len(candidates.who) > size:  # so many that it pays to drop those next to feet found first
        which, u, v = candidates.first()
        other = projector(left[which], u, v)
        everywhere_u, everywhere_v = best["u"][left], best["v"][left]
        everywhere_u[which], everywhere_v[which] = other["u"], other["v"]
        candidates.found(everywhere_u, everywhere_v)
        take_nearer(best, left[which], other)
    which, u, v = candidates.rest()
    for begin in range(0, which.size, MOST_STARTS):
        part = slice(begin, begin + MOST_STARTS)
        chosen = left[which[part]]
        take_nearer(best, chosen, projector(chosen, u[part], v[part]))


def _in_use(axis: Axis, count: int) -> Axis:
    """The cells of the first `count` control points."""
    width = axis.polynomials.shape[1]
    cells = count - width + 1
    if cells == axis.cells:
        return axis
    last = np.int32(cells - 1)
    numbers = {
        name: np.minimum(getattr(axis, name)[:cells], last) for name in ("first", "last", "before", "after")
    }
    return Axis(
        breaks=axis.breaks[: cells + 1],
        bounds=axis.bounds[:, :cells],
        ends=np.minimum(axis.ends, last),
        polynomials=axis.polynomials[:cells],
        creased=axis.creased,
        **numbers,
    )


def _middle(net: np.ndarray) -> np.ndarray:
    """Centre of the box around the net, about which coordinates carry the least rounding."""
    return 0.5 * (net.min(axis=(0, 1)) + net.max(axis=(0, 1)))


def _box(net: np.ndarray, centred: np.ndarray) -> np.ndarray:
    """The sides of the box around control points and queries."""
    low = np.minimum(net.min(axis=(0, 1)), centred.min(axis=1))
    high = np.maximum(net.max(axis=(0, 1)), centred.max(axis=1))
    return high - low


def take_nearer(best: HostFeet, which: np.ndarray, other: HostFeet) -> None:
    """Replace feet by nearer ones; `which` may name a point several times."""
    np.add.at(best["steps"], which, other["steps"])
    # Of each point's, the converged ones first and of these the nearest.
    order = np.lexsort((other["f"], ~other["converged"], which))
    first = order[np.unique(which[order], return_index=True)[1]]
    mine = which[first]
    nearer = other["f"][first] < best["f"][mine]
    nearer &= other["converged"][first] | ~best["converged"][mine]
    for name in best.keys() - {"steps"}:
        best[name][..., mine[nearer]] = other[name][..., first[nearer]]
