"""`history`: the errors of every iteration of a fit."""

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfit.plot._part import check_fit
from jaxfit.plot._picture import blank_figure, finished

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def history(fit: Any, path: str | os.PathLike | None = None, title: str = "", dpi: int = 150) -> "Figure":
    """One picture of the average and the maximum error after every iteration, in % of the diagonal.

    Parameters
    ----------
    fit
        A `jaxfit.Fit`.
    path
        Where to save the picture (.png, .pdf, .svg, ...), whole or not at all; None saves nothing.
    title
        Heading, for instance the name of the data.
    dpi
        Pixels per inch; the picture is 7 x 5.2 inches.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ImportError
        If Matplotlib is not installed.
    TypeError
        If `fit` is no fit.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 5), indexing="ij")
    >>> fit = jf.interpolate(np.stack([x, y, x * y], axis=2), jf.StandardInterpolation())
    >>> jf.plot.history(fit).get_size_inches().tolist()
    [7.0, 5.2]
    """
    check_fit(fit)
    figure = blank_figure(7)
    axes = figure.subplots()
    steps = int(fit.stats["num_steps"]) + 1
    for which, colour in (("maximum", "tab:orange"), ("average", "tab:blue")):
        errors = 100 * np.asarray(getattr(fit.history, which), float)[:steps]
        first = steps - len(errors)  # of very long fits the last iterations are kept
        axes.plot(first + np.arange(len(errors)), errors, "o-", markersize=3, color=colour, label=which)
        if (errors > 0).any():
            axes.set_yscale("log")
    axes.set_xlabel("iteration")
    axes.set_ylabel("error, % of the diagonal")
    axes.grid(color="0.9")
    axes.legend()
    return finished(figure, path, title, dpi)
