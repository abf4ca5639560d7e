"""`surface_and_errors`: the fitted surface beside its errors."""

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.typing import ArrayLike

from jaxfit._fit._summary import errors_of_all
from jaxfit._trimmed import TrimmedSurface
from jaxfit._trimmed._trimmed_surface import host_loops
from jaxfit.io._output import PICTURES, check_output, write_atomically
from jaxfit.plot._part import check_fit, folds_in, of_fit
from jaxfit.plot._render import render
from jaxfit.plot._view import View

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LARGEST_SCATTER = 20_000  # points; more are drawn as a raster
_COLOURS = "inferno"
_FOLDS = "deepskyblue"  # which the colours of errors are not
_LOOP = "tab:blue"


def surface_and_errors(
    fit: Any,
    points: ArrayLike | None = None,
    path: str | os.PathLike | None = None,
    title: str = "",
    dpi: int = 150,
) -> "Figure":
    """One picture: on the left the surface, on the right its distance from every data point.

    The surface is shaded and carries some of its knot lines. A flat one (terrain) is stretched
    along its short axis, and the caption says by how much. Errors are coloured in % of the
    diagonal of the data's bounding box, over the parameters (u, v) of the points, or over the
    rows and columns of a grid, which run the way they run on the left: their numbers may grow
    from right to left. Colours end at the 99.5th percentile, so that a few outliers do
    not hide the rest. Of more than 20,000 scattered points every cell of a raster shows its
    largest error. Folds of the surface (`fit.regularity`) are red on the left and crosses on the
    right; the caption counts them. It has the smallest angle between parameter lines and the
    thin-plate energy in squared diagonals, too. Of a fit with loops (`fit.trimmed`) both sides show what is
    inside them, and the loops; the caption has the errors inside and of all points. Neither pyplot nor a
    backend is touched.

    Parameters
    ----------
    fit
        What `jaxfit.interpolate`, `jaxfit.approximate` or `jaxfit.fit_points` returned.
    points : array (N, d) or (n, m, d), optional
        The data. Needed only for a grid (n, m, d) that was fitted as scattered points, row by
        row: its errors are then drawn in rows and columns.
    path
        Where to save the picture (.png, .pdf, .svg, ...); None saves nothing.
    title
        Heading, for instance the name of the data.
    dpi
        Pixels per inch; the picture is 12 x 5.2 inches.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ImportError
        If Matplotlib is not installed.
    TypeError
        If `points` is the name of a file, or `fit` is no fit.
    ValueError
        If `points` is a grid whose size is not the number of errors.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 5), indexing="ij")
    >>> fit = jf.interpolate(np.stack([x, y, x * y], axis=2), jf.StandardInterpolation())
    >>> jf.plot.surface_and_errors(fit, title="a saddle").get_size_inches().tolist()
    [12.0, 5.2]
    """
    check_fit(fit)
    if isinstance(points, (str, os.PathLike)):
        raise TypeError(f"points must be an array, but is {points!r}; pass a file as path={str(points)!r}.")
    errors = _arrange(fit.errors, points)
    figure = blank_figure(12)
    left, right = figure.subplots(1, 2, width_ratios=(1.1, 1))
    view = _draw_surface(left, fit)
    _draw_errors(right, fit, 100 * errors, view)
    return finished(figure, path, title, dpi)


def surface_beside_errors(fit: Any, points: ArrayLike | None = None) -> tuple["Figure", "Figure"]:
    """The two sides of `surface_and_errors` as pictures of their own."""
    errors = _arrange(fit.errors, points)
    left, right = blank_figure(7), blank_figure(7)
    view = _draw_surface(left.subplots(), fit)
    _draw_errors(right.subplots(), fit, 100 * errors, view)
    return left, right


def _arrange(errors: ArrayLike, points: ArrayLike | None) -> np.ndarray:
    errors = np.asarray(errors, dtype=float)
    if points is None or np.ndim(points) != 3 or errors.ndim == 2:
        return errors
    shape = np.shape(points)[:2]
    if errors.size != shape[0] * shape[1]:
        raise ValueError(
            f"points is a grid of {shape[0]} x {shape[1]}, but the fit has {errors.size} errors; "
            "give the points that were fitted."
        )
    return errors.reshape(shape)


def _draw_surface(axes: "Axes", fit: Any) -> View:
    part = of_fit(fit)
    image, view = render(part, folds=folds_in(part, fit.regularity))
    axes.imshow(image)
    axes.set_axis_off()
    axes.set_title(_caption(fit, view), fontsize=11)
    return view


def _caption(fit: Any, view: View) -> str:
    found, part = fit.regularity, of_fit(fit)
    count = len(folds_in(part, found))
    folds = {0: "no folds", 1: "1 fold"}.get(count, f"{count:,} folds")
    caption = "{} \N{MULTIPLICATION SIGN} {} control points, {}".format(*fit.surface.shape, folds)
    if view.factor > 1:
        caption += f", {view.relief} stretched {view.factor} times"
    plate = found.thin_plate_energy / float(fit.stats["diagonal"]) ** 2
    return (
        f"{caption}\nlines at least {np.degrees(found.smallest_angle):.3g}\N{DEGREE SIGN} apart, "
        f"thin-plate energy {plate:.4g}"
    )


def _draw_errors(axes: "Axes", fit: Any, errors: np.ndarray, view: View) -> None:
    trimmed = getattr(fit, "trimmed", None)
    inside = np.ones(errors.size, bool) if trimmed is None else np.asarray(fit.inside).reshape(-1)
    if trimmed is not None:
        errors = errors.reshape(-1)[inside]  # of a grid, too: loops are drawn over parameters
    top = float(np.percentile(errors, 99.5)) if errors.size else 0.0
    top = top or 1.0
    drawn: Any
    style: dict[str, Any] = {"cmap": _COLOURS, "vmin": 0.0, "vmax": top}
    label = "error, % of the diagonal"
    u, v = (np.asarray(x, dtype=float).ravel()[inside] for x in (fit.u, fit.v))
    if errors.ndim == 2:
        drawn = axes.imshow(errors.T, origin="lower", aspect="auto", **style)
        axes.set_xlabel("row of the grid (along u)")
        axes.set_ylabel("column of the grid (along v)")
    else:
        axes.set_facecolor("0.92")
        axes.set_xlabel("u")
        axes.set_ylabel("v")
        if errors.size > _LARGEST_SCATTER:
            raster, edges_u, edges_v = _largest_per_cell(u, v, errors)
            drawn = axes.pcolormesh(edges_u, edges_v, raster.T, **style)
            label = "largest error per cell, % of the diagonal"
        else:
            size = np.clip(7e4 / max(errors.size, 1), 1.5, 60.0)
            drawn = axes.scatter(u, v, c=errors, s=size, linewidths=0, **style)
        axes.margins(0.02)
    draw_loops(axes, trimmed)
    _mark_folds(axes, fit, errors.shape)
    _turn_like_the_surface(axes, fit.surface, view)
    bar = axes.figure.colorbar(drawn, ax=axes, extend="max", pad=0.02)
    bar.set_label(label)
    average, maximum = 100 * float(fit.average_error), 100 * float(fit.maximum_error)
    if trimmed is not None:  # and points may have been left out
        average, maximum = errors_of_all(fit)
    caption = f"average {average:.3g} %, maximum {maximum:.3g} % of the diagonal"
    if errors.size and trimmed is not None:
        finite = int(np.isfinite(np.asarray(fit.errors)).sum())
        within = f"inside the loops: average {errors.mean():.3g} %, maximum {errors.max():.3g} %"
        caption = f"{within}\nall {finite:,} points: {caption}"
    folds = len(folds_in(of_fit(fit), fit.regularity))
    axes.set_title(caption + ("\ncrosses: folds" if folds else ""), fontsize=11)


def draw_loops(axes: "Axes", trimmed: TrimmedSurface | None) -> None:
    """The outer loop as a full line and the holes as dashed ones, over the parameters."""
    for i, loop in enumerate([] if trimmed is None else host_loops(trimmed)):
        closed = np.concatenate([loop, loop[:1]])
        axes.plot(*closed.T, color=_LOOP, linewidth=1.2, linestyle="--" if i else "-")


def _mark_folds(axes: "Axes", fit: Any, shape: tuple[int, ...]) -> None:
    """A cross at each fold, over the parameters or over the rows and columns of a grid."""
    places = folds_in(of_fit(fit), fit.regularity)
    if not len(places):
        return
    at = list(places.T)
    if len(shape) == 2:
        for axis, parameters in enumerate((fit.u, fit.v)):
            line = np.asarray(parameters, float).reshape(shape).mean(axis=1 - axis)
            at[axis] = np.interp(at[axis], np.maximum.accumulate(line), np.arange(shape[axis]))
    axes.scatter(at[0], at[1], marker="x", s=12, linewidths=0.8, color=_FOLDS, label="folds")


def _largest_per_cell(
    u: np.ndarray, v: np.ndarray, errors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Raster of the largest error in every cell, about five points a cell; NaN where none is."""
    side = int(np.clip(np.sqrt(errors.size / 5), 16, 400))
    edges = [np.linspace(x.min(), x.max() + np.spacing(x.max()), side + 1) for x in (u, v)]
    i, j = (
        np.clip(np.searchsorted(edge, x, side="right") - 1, 0, side - 1)
        for edge, x in zip(edges, (u, v), strict=True)
    )
    raster = np.full((side, side), -1.0)
    np.maximum.at(raster, (i, j), errors)
    return np.where(raster < 0, np.nan, raster), edges[0], edges[1]


def _turn_like_the_surface(axes: "Axes", surface: Any, view: View) -> None:
    """Let u and v run the way they run in the left picture (right or left, up or down)."""
    net = np.asarray(surface.control_points, dtype=float)
    if net.shape[-1] != 3:
        return
    corners = view(net[[0, -1]][:, [0, -1]])
    along_u = (corners[1] - corners[0]).mean(axis=0)
    along_v = (corners[:, 1] - corners[:, 0]).mean(axis=0)
    if along_u[0] < 0:
        axes.invert_xaxis()
    if along_v[1] < 0:
        axes.invert_yaxis()


def blank_figure(width: int, rows: int = 1) -> "Figure":
    """A figure of this many inches by 5.2 for each row, without pyplot."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(
            'pictures need Matplotlib, which is not installed; pip install "jaxfit-surfaces[plot]".'
        ) from error
    figure = Figure(figsize=(width, 5.2 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def finished(figure: "Figure", path: str | os.PathLike | None, title: str, dpi: int) -> "Figure":
    """The figure with its title, written if there is a path: whole or not at all."""
    if title:
        figure.suptitle(title, fontsize=14, fontweight="bold")
    if path is None:
        return figure
    check_output(path, PICTURES)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=Path(path).suffix.lstrip(".").lower(), dpi=dpi)
    write_atomically(path, buffer.getvalue())
    return figure
