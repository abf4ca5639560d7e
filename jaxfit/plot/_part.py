"""The part of a surface that is drawn: all of it, or what is inside loops."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxfit._quality import Regularity
from jaxfit._splines import BSplineSurface
from jaxfit._trimmed import TrimmedSurface
from jaxfit._trimmed._inside import inside_on_grid
from jaxfit._trimmed._trimmed_surface import host_loops, loop_edges

Ranges = list[tuple[float, float]]


def check_fit(fit: Any) -> None:
    """Raise unless `fit` has the errors of a fit."""
    if not hasattr(fit, "errors"):
        raise TypeError(
            f"fit must be what a fit returned, but is a {type(fit).__name__}; draw surfaces alone by "
            "zebra_stripes."
        )


def of_fit(fit: Any) -> BSplineSurface | TrimmedSurface:
    """What a picture of a fit shows."""
    trimmed = getattr(fit, "trimmed", None)
    return fit.surface if trimmed is None else trimmed


def whole(part: BSplineSurface | TrimmedSurface) -> BSplineSurface:
    """The surface without its loops."""
    return part.surface if isinstance(part, TrimmedSurface) else part


def ranges(part: BSplineSurface | TrimmedSurface) -> Ranges:
    """The domain, or the box round the outer loop."""
    if isinstance(part, TrimmedSurface):
        outer = host_loops(part)[0]
        return [(float(low), float(high)) for low, high in zip(outer.min(0), outer.max(0), strict=True)]
    return [(float(low), float(high)) for low, high in part.domain]


def shown(
    part: BSplineSurface | TrimmedSurface, us: Float[np.ndarray, " a"], vs: Float[np.ndarray, " b"]
) -> Bool[np.ndarray, "a b"]:
    """Which samples on a grid of parameters belong to the part."""
    if isinstance(part, TrimmedSurface):
        return inside_on_grid(loop_edges(part), us, vs)
    return np.ones((len(us), len(vs)), bool)


def folds_in(part: BSplineSurface | TrimmedSurface, found: Regularity) -> Float[np.ndarray, "folds 2"]:
    """Parameters of those folds of its surface that are in the part."""
    places = found.fold_parameters
    if not (len(places) and isinstance(part, TrimmedSurface)):
        return places
    return places[np.asarray(part.contains(*places.T))]
