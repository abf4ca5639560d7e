"""Where methods that find feet themselves begin: near the nearest feet of almost all points.

Of the points whose foot may not be the nearest some are searched for, in every cell, and the others only
where one of these has a nearer foot elsewhere.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfit._closest._chunks import HostFeet, chunk_size, places
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._projector import Projector
from jaxfit._closest._surface_search import SurfaceSearch, search_borders
from jaxfit._splines._pieces import Axis

SOME = 2  # points in a cell show whether there are nearer feet elsewhere
MUCH_NEARER = 0.999  # of a squared distance


def starting_feet(
    method: AbstractFootMethod,
    net: Float[Any, "nu nv d"],
    axis_u: Axis,
    axis_v: Axis,
    points: Float[np.ndarray, "points d"],
    *,
    tolerance: float,
    max_steps: int,
    used: tuple[int, int] | None = None,
    chunk: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (u, v) from which nearly all local feet are the nearest; see `nearest_feet`."""
    chunk = chunk or chunk_size(len(points))
    projector = Projector(method, net, (axis_u, axis_v), points, tolerance, max_steps, chunk)
    search = SurfaceSearch(projector, used or net.shape[:2])
    best = search.local_feet()
    search.retry_lost(best)
    _search_cell_by_cell(search, search.doubtful(best), best)
    search_borders(projector, best)  # a foot that can't be found costs the fit all evaluations it has
    return best["u"], best["v"]


def _search_cell_by_cell(search: SurfaceSearch, left: Int[np.ndarray, " _"], best: HostFeet) -> None:
    """Search for SOME of the points `left` in each cell, and for the other points of cells where that has
    found much nearer feet, and of the cells around these. Where points are few all are searched for.
    """
    axes = search.projector.axes
    cells = axes[0].cells, axes[1].cells
    every = max(left.size // (SOME * cells[0] * cells[1]), 1)
    place = places(axes, best["u"][left], best["v"][left])
    some = np.argsort(place, kind="stable")[::every]
    limit = MUCH_NEARER * best["f"][left[some]]
    search.try_candidates(left[some], best)
    farther = best["f"][left[some]] < limit
    if every == 1 or not farther.any():
        return
    row, column = np.divmod(place[some[farther]], cells[1])
    around = np.zeros((cells[0] + 2, cells[1] + 2), bool)
    for i, j in np.ndindex(3, 3):
        around[row + i, column + j] = True
    chosen = around[1:-1, 1:-1].reshape(-1)[place]
    chosen[some] = False
    search.try_candidates(left[chosen], best)
