"""`Room`: what the fits of one cloud have room for, so that one program serves them, and searches in it."""

from typing import Any, NamedTuple

import numpy as np

from jaxfit._checks import eager_where_concrete
from jaxfit._closest import Newton, nearest_feet, starting_feet
from jaxfit._fit._working_surface import WorkingSurface
from jaxfit._precision import default_foot_tolerance
from jaxfit._splines import BSplineSurface

MAX_STEPS = 60  # evaluations of a foot in the global search


class Room(NamedTuple):
    """What a fit has room for: fits with the same room are one program.

    `points` is the size of the whole cloud, of which the fit may be given a part, and `chunk` how many of
    them are searched for at a time.
    """

    net: tuple[int, int]
    steps: int
    points: int
    chunk: int


@eager_where_concrete
def nearest_on(surface: BSplineSurface, points: Any, known: Any = None, room: Room | None = None) -> Any:
    """The nearest feet on the whole surface, all concrete; `known` as for `nearest_feet`."""
    return nearest_feet(*_searched(surface, points, room), known=known, **_options(surface, room))


@eager_where_concrete
def starts_on(surface: BSplineSurface, points: Any, room: Room | None = None) -> Any:
    """Parameters to begin with for methods that find feet themselves, all concrete."""
    return starting_feet(*_searched(surface, points, room), **_options(surface, room))


def _searched(surface: BSplineSurface, points: Any, room: Room | None) -> tuple[Any, ...]:
    """How feet move, the surface, and the points."""
    net, u, v = (np.asarray(x) for x in (surface.control_points, surface.knots_u, surface.knots_v))
    whole = WorkingSurface.of(net, u, v)
    if room is not None:
        whole = whole.padded(room.net[0] - net.shape[0], room.net[1] - net.shape[1])
    return Newton(), whole.control_points, *whole.axes, np.asarray(points)


def _options(surface: BSplineSurface, room: Room | None) -> dict[str, Any]:
    return {
        "tolerance": default_foot_tolerance(np.dtype(surface.control_points.dtype)),
        "max_steps": MAX_STEPS,
        "used": surface.shape,
        "chunk": None if room is None else room.chunk,
    }
