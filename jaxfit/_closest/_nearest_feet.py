"""Nearest feet of concrete points: local ones, and searched for above the reach of the surface."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxfit._closest._chunks import CHUNK, HostFeet, chunk_size
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._projector import Projector
from jaxfit._closest._surface_search import SurfaceSearch, search_borders
from jaxfit._splines._pieces import Axis


def nearest_feet(
    method: AbstractFootMethod,
    net: Float[Any, "nu nv d"],
    axis_u: Axis,
    axis_v: Axis,
    points: Float[np.ndarray, "points d"],
    *,
    start: tuple[Any, Any] | None = None,
    known: tuple[Any, Any, Any, Any] | None = None,
    tolerance: float,
    max_steps: int,
    used: tuple[int, int] | None = None,
    chunk: int | None = None,
    borders: bool = True,
) -> HostFeet:
    """Feet of all points: `u`, `v`, `distance`, `converged`, `steps`, and `point` on the surface.

    From `start`, a pair (u, v), the feet are local ones. Without it they are the nearest of all: in large
    clouds points whose foot is below the estimated reach of the surface are done, and the others are searched
    for. `known` are feet (u, v, distance, converged) found before, with which the search begins; `point` is
    then left out. `tolerance` is a fraction of the extent. Of a net with surplus control points, behind
    repeated end knots, `used` says how many are in use along u and v. `chunk` is how many points are
    projected at a time; by default that depends on how many there are. Feet that do not converge are searched
    for on the `borders`.
    """
    if chunk is None:
        chunk = chunk_size(len(points) if known is None else min(len(points), CHUNK))
    projector = Projector(method, net, (axis_u, axis_v), points, tolerance, max_steps, chunk)
    if start is not None:
        best = projector(None, *start)
    else:
        best = _globally(projector, known, used or net.shape[:2])
    if borders:
        search_borders(projector, best)
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
    Projector(method, net, (axis_u, axis_v), np.zeros((1, net.shape[2])), 0.0, 1, chunk).compile_ahead()


def _globally(projector: Projector, known: Any, used: tuple[int, int]) -> HostFeet:
    """The nearest foot of all."""
    search = SurfaceSearch(projector, used, once=known is not None)
    if known is None:
        best = search.local_feet()
    else:
        names = ("u", "v", "distance", "converged")
        best = {name: np.array(x) for name, x in zip(names, known, strict=True)}
        squares = (best.pop("distance") / projector.unit) ** 2
        best |= {"f": squares, "steps": np.zeros(squares.size, np.int32)}
    search.retry_lost(best)
    search.try_candidates(search.doubtful(best), best)
    return best
