"""`zebra_stripes`: surfaces side by side, as a striped room is reflected in them."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfit._checks import as_direction, check_kind
from jaxfit._quality import regularity
from jaxfit._quality._zebra import Vector, zebra_grid
from jaxfit._splines import BSplineSurface
from jaxfit._trimmed import TrimmedSurface
from jaxfit.plot._part import folds_in, of_fit, whole
from jaxfit.plot._picture import blank_figure, finished
from jaxfit.plot._render import FOLD, coarse_points, render
from jaxfit.plot._view import View, choose_view, view_from

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DARK = np.array([0.07, 0.09, 0.13])
_BRIGHT = np.array([0.97, 0.96, 0.93])
_SHARPNESS = 4.0  # a wave of this height, cut at 0 and 1, is nearly a step


def zebra_stripes(
    surfaces: BSplineSurface | TrimmedSurface | Sequence[BSplineSurface | TrimmedSurface],
    path: str | os.PathLike | None = None,
    captions: Sequence[str] = (),
    stripes: int = 16,
    direction: Vector | None = None,
    view: Vector | None = None,
    title: str = "",
    dpi: int = 150,
    shaded: bool = False,
) -> "Figure":
    """One picture of the zebra stripes of one or several surfaces, side by side in one view.

    Stripes show what shading hides: where they wiggle, kink or break, so do curvatures and normals.
    The stripes are those of `jaxfit.zebra`, cut nearly sharp; places without a normal, and
    folds (`jaxfit.regularity`), are red. Neither pyplot nor a backend is touched.

    Parameters
    ----------
    surfaces
        What to draw, in three dimensions, best in the same place and unit; also fits. Of trimmed surfaces
        only what is inside the loops.
    path
        Where to save the picture (.png, .pdf, .svg, ...), whole or not at all; None saves nothing.
    captions
        One for each surface, or none.
    stripes
        Bright stripes in half a turn of the reflected ray (default 16).
    direction : array (3,), optional
        Axis of the lights, across which stripes run. Default: upward in the picture.
    view : array (3,), optional
        Direction from the surfaces to the eye. Default: the outer side of the first surface. To
        judge a symmetry, look along its plane.
    title
        Heading, for instance the name of the data.
    dpi
        Pixels per inch; each surface takes 6 x 5.2 inches.
    shaded
        Whether to show each surface shaded as well, above its stripes and in the same view.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ImportError
        If Matplotlib is not installed.
    ValueError
        If there is no surface, one is not in three dimensions, or there are more or fewer captions.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 5), indexing="ij")
    >>> fit = jf.interpolate(np.stack([x, y, x * y], axis=2), jf.StandardInterpolation())
    >>> jf.plot.zebra_stripes(fit.surface).get_size_inches().tolist()
    [6.0, 5.2]
    """
    drawn = _checked(surfaces, captions)
    camera = _camera(drawn[0], view)
    axis = camera.up if direction is None else direction
    rows = 2 if shaded else 1
    figure = blank_figure(6 * len(drawn), rows)
    axes = figure.subplots(rows, len(drawn), squeeze=False)
    for i, surface in enumerate(drawn):
        places = folds_in(surface, regularity(whole(surface)))
        if shaded:
            axes[0, i].imshow(render(surface, view=camera, folds=places)[0])
        axes[-1, i].imshow(_striped(surface, camera, axis, stripes, places))
        if captions:
            axes[0, i].set_title(captions[i], fontsize=11)
    for place in axes.flat:
        place.set_axis_off()
    return finished(figure, path, title, dpi)


def _striped(
    part: BSplineSurface | TrimmedSurface, camera: View, axis: Vector, stripes: int, folds: np.ndarray
) -> np.ndarray:
    def paint(us: np.ndarray, vs: np.ndarray) -> np.ndarray:
        values = np.asarray(zebra_grid(whole(part), us, vs, axis, stripes, camera.toward), dtype=float)
        bright = np.clip(0.5 + _SHARPNESS * (values - 0.5), 0, 1)[..., None]
        return np.where(np.isnan(bright), FOLD, _DARK + bright * (_BRIGHT - _DARK))

    return render(part, view=camera, paint=paint, folds=folds)[0]


def _camera(part: BSplineSurface | TrimmedSurface, view: Vector | None) -> View:
    if view is None:
        # The eye of the chosen view, but no stretch: stripes are those of the true shape.
        return view_from(choose_view(coarse_points(part)[2]).toward)
    return view_from(np.asarray(as_direction("view", view, 3), dtype=float))


def _checked(
    surfaces: BSplineSurface | TrimmedSurface | Sequence[BSplineSurface | TrimmedSurface],
    captions: Sequence[str],
) -> list[BSplineSurface | TrimmedSurface]:
    single = isinstance(surfaces, (BSplineSurface, TrimmedSurface)) or hasattr(surfaces, "errors")
    given: list[Any] = [surfaces] if single else list(surfaces)  # type: ignore[arg-type]
    drawn = [of_fit(x) if hasattr(x, "errors") else x for x in given]
    if not drawn:
        raise ValueError("surfaces must hold at least one surface, but is empty; give one.")
    for surface in drawn:
        kinds = (BSplineSurface, TrimmedSurface)
        check_kind("surfaces", surface, kinds, "a BSplineSurface or a list of them")
        if whole(surface).dimension != 3:
            raise ValueError(
                f"surfaces must be in three dimensions, but one has {whole(surface).dimension}; use affine() "
                "to take it there."
            )
    if captions and len(captions) != len(drawn):
        raise ValueError(
            f"captions must be one for each of the {len(drawn)} surfaces, but there are {len(captions)}; "
            "give as many, or none."
        )
    return drawn
