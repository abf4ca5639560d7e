"""`SurfaceSearch`: local feet from samples of a surface, and the search for nearer ones elsewhere on it."""

from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxfit._closest._candidates import Search
from jaxfit._closest._chunks import HostFeet, neighbours_together
from jaxfit._closest._projector import LAST_SURFACES, Projector
from jaxfit._closest._reach import POINTS_PER_SAMPLE, Reach, number_of_samples
from jaxfit._closest._samples import sample
from jaxfit._remembered import remembered
from jaxfit._splines._pieces import Axis

MOST_POINTS, MOST_STARTS = 1 << 14, 1 << 16  # tried in one go, for the memory's sake
# Where cells are few the reach costs little, and it spares searches that exchange feet for the same ones with
# other last digits.
LEAST_POINTS_PER_CELL = 24


class SurfaceSearch:
    """Searches the surface of a projector, of whose control points `used` are in use along u and v.

    What is made of a surface that is searched `once`, as the one a fit ends with, is not remembered.
    """

    def __init__(self, projector: Projector, used: tuple[int, int], once: bool = False):
        self.projector, self._once = projector, once
        self.net = projector.net[: used[0], : used[1]]
        self.axes = [_in_use(axis, count) for axis, count in zip(projector.axes, used, strict=True)]

    @cached_property
    def samples(self) -> Search:
        """Samples of the surface, made when first asked for: large clouds may do without."""
        made = _search_of if self._once else _remembered_search_of
        return made(self.net.astype(self.projector.dtype), *self.axes)

    def local_feet(self, which: Any = None) -> HostFeet:
        """Feet of the points `which` (None: all), found from samples near these."""
        self.projector.compile_ahead()  # while SciPy's trees are imported and searched
        points = self.projector.centred.T
        start = self.samples.nearest(points if which is None else points[which])
        return {name: np.array(x) for name, x in self.projector(which, *start).items()}

    def retry_lost(self, best: HostFeet) -> None:
        """Find feet that have not converged from their own nearest samples."""
        lost = np.flatnonzero(~best["converged"])
        if lost.size:
            take_nearer(best, lost, self.local_feet(lost))

    def doubtful(self, best: HostFeet) -> Int[np.ndarray, " _"]:
        """The points for which there may be nearer feet: all where the reach is not estimated, since tangent
        planes jump, points are not in space or too few.
        """
        axes, count = self.axes, best["f"].size
        smooth = not (axes[0].creased or axes[1].creased) and axes[1].polynomials.shape[1] > 1
        cells = axes[0].cells * axes[1].cells
        enough = min(POINTS_PER_SAMPLE * number_of_samples(*axes), LEAST_POINTS_PER_CELL * cells)
        if not smooth or self.net.shape[2] != 3 or count < enough:
            return np.arange(count)
        made = Reach if self._once else _remembered_reach_of
        below = made(self.net, *axes).exceeds(best["u"], best["v"], np.sqrt(best["f"]))
        return np.flatnonzero(~(below & best["converged"]))

    def try_candidates(self, left: np.ndarray, best: HostFeet) -> None:
        """Start from every sample that may lead to a nearer foot of the points `left`, if there are any."""
        if not left.size:
            return
        # In the tree neighbours are found faster one after the other.
        left = left[neighbours_together(self.projector.axes, best["u"][left], best["v"][left])]
        for begin in range(0, left.size, MOST_POINTS):
            self._try_candidates_of(left[begin : begin + MOST_POINTS], best)

    def _try_candidates_of(self, left: np.ndarray, best: HostFeet) -> None:
        """`try_candidates` of MOST_POINTS at most."""
        distance = np.sqrt(best["f"][left].astype(np.float64))
        points = np.ascontiguousarray(self.projector.centred.T[left])
        candidates = self.samples.candidates(points, best["u"][left], best["v"][left], distance)
        size = self.projector.size
        if len(candidates.who) > size:  # so many that it pays to drop those next to feet found first
            which, u, v = candidates.first()
            other = self.projector(left[which], u, v)
            everywhere_u, everywhere_v = best["u"][left], best["v"][left]
            everywhere_u[which], everywhere_v[which] = other["u"], other["v"]
            candidates.found(everywhere_u, everywhere_v)
            take_nearer(best, left[which], other)
        which, u, v = candidates.rest()
        for begin in range(0, which.size, MOST_STARTS):
            part = slice(begin, begin + MOST_STARTS)
            chosen = left[which[part]]
            take_nearer(best, chosen, self.projector(chosen, u[part], v[part]))


def _search_of(net: np.ndarray, axis_u: Axis, axis_v: Axis) -> Search:
    return Search(sample(net, axis_u, axis_v))


_remembered_search_of = remembered(LAST_SURFACES)(_search_of)
_remembered_reach_of = remembered(LAST_SURFACES)(Reach)


def search_borders(projector: Projector, best: HostFeet) -> None:
    """Search for feet that have not converged on the borders, too."""
    lost = np.flatnonzero(~best["converged"])
    if lost.size:
        best |= {name: np.array(x) for name, x in best.items()}  # those of JAX can't be written to
        take_nearer(best, lost, projector(lost, best["u"][lost], best["v"][lost], borders=True))


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
