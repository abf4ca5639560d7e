"""`approximate_stream`: fits a base surface to points that are read in blocks, again and again."""

import os
from typing import Any

from jax.typing import ArrayLike

from jaxfit._approximation import StandardApproximation
from jaxfit._approximation._errors import AbstractErrors
from jaxfit._fit._loop import Progress
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._result import Fit
from jaxfit._progress_line import shows_progress
from jaxfit._splines import BSplineSurface
from jaxfit._streams._blocks import Source
from jaxfit._streams._stream_fit import fit_stream


@shows_progress("reading a cloud")
def approximate_stream(
    source: Source,
    base: BSplineSurface,
    method: AbstractIterativeMethod | None = None,
    tol_average: ArrayLike | None = 6e-4,
    tol_maximum: ArrayLike | None = None,
    max_steps: int = 200,
    weights: ArrayLike | None = None,
    start: Any = None,
    progress: Progress | None = None,
    throw: bool = False,
    errors: AbstractErrors | None = None,
    block_size: int = 1 << 18,
    feet_file: str | os.PathLike[str] | None = None,
) -> Fit:
    r"""`approximate` for a cloud that does not fit in memory: the same surface, from passes over blocks.

    A move of either method follows from sums over the points at their feet. For Algorithm 1 these are
    $\sum_k w_k N_i N_j\, e_k$ and $\sum_k w_k N_i N_j$, for the least squares of equation (11) the normal
    matrix $A^T W A$ and $A^T W (A P - Q)$. Each pass reads one block after the other, finds its feet and adds
    up its sums. What stays is of the size of the net, and twelve bytes a point.

    Parameters
    ----------
    source : path of a .npy file, array (points, d), iterable or callable
        An array may be a mapped file, `np.load(path, mmap_mode="r")`. Something that can be iterated again
        and again, or a function that returns an iterator, gives arrays (any number of points, d) of the same
        points in every pass.
    base : BSplineSurface
        A first approximation, for instance from `base_surface` of a sample of the points.
    method : StandardApproximation() or GeometricApproximation(), optional
        Default StandardApproximation(), which needs the fewest passes. Without insertion, `local=True` and
        lambda chosen from the data; a loss needs its scale, as in ``jf.Huber(1e-3)``.
    tol_average : float or None
        As for `approximate`.
    tol_maximum : float or None
        As for `approximate`.
    max_steps : int
        As for `approximate`. Each iteration is one pass over the points.
    weights : array (points,), optional
        The non-negative weight of each point (default 1), in the order of the source; may be a mapped file.
    start : pair of arrays (points,), optional
        Feet (u, v) on the base surface to start from; default the closest points, searched globally.
    progress : callable, optional
        As for `approximate`; called once an iteration.
    throw : bool
        As for `approximate`.
    errors : GlobalFeet(), LocalFeet() or AtParameters(), optional
        As for `approximate`.
    block_size : int
        The number of points at a time (default 262,144). One program is compiled for it. Up to four cores of
        a CPU work on a block each.
    feet_file : path, optional
        A `.npy` file to be written, with an array (3, points) of u, v and errors, instead of memory.

    Returns
    -------
    Fit
        Its `u`, `v` and `errors` are NumPy arrays (points,) in single precision, rows of `feet_file` where
        that is given. Average and maximum error are those of double precision. `stats["passes"]` counts how
        often the points were read.

    Raises
    ------
    ValueError
        If a block is not finite or has the wrong shape, which the sentence says by the number of the block;
        if the source holds fewer than four points or gives others in a later pass; or as `approximate` does.
    FileNotFoundError
        If the source is the path of a file that does not exist.
    TypeError
        If the method needs all points together, or the source is an iterator, which can be read only once.

    Notes
    -----
    Between passes parameters are kept as fixed-point numbers of 48 bits, $3.6 \cdot 10^{-15}$ of the domain
    apart, so the surface is that of `approximate` to rounding. The exception is
    `GeometricApproximation(single_step=False)`: there feet start from the last ones, in `approximate` ahead
    of them, so a point with several feet may go to another one.
    Not under `jit`, `vmap` or `grad`.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 10), np.linspace(0, 1, 6), indexing="ij")
    >>> grid = np.stack([x, y, x * y], axis=2)
    >>> base = jf.base_surface(jf.Boundary.from_grid(grid), net=(6, 5))
    >>> points = grid.reshape(-1, 3) + 0.2 * np.sin(3 * x * y).reshape(-1, 1)
    >>> fit = jf.approximate_stream(points, base, max_steps=2, block_size=25)
    >>> fit.surface.shape, fit.errors.shape, fit.stats["passes"]
    ((6, 5), (60,), 5)
    >>> again = jf.approximate_stream(lambda: (points[k : k + 7] for k in range(0, 60, 7)), base, max_steps=2)
    >>> bool(abs(again.surface.control_points - fit.surface.control_points).max() < 1e-9)
    True
    """
    request = {
        "tol_average": tol_average,
        "tol_maximum": tol_maximum,
        "max_steps": max_steps,
        "weights": weights,
        "start": start,
        "progress": progress,
        "throw": throw,
        "errors": errors,
    }
    method = StandardApproximation() if method is None else method
    return fit_stream(source, base, method, block_size, feet_file, request)
