"""`approximate`: fits a base surface to scattered points."""

from typing import Any

from jax.typing import ArrayLike

from jaxfit._approximation._cloud_fit import fit_cloud
from jaxfit._approximation._errors import AbstractErrors
from jaxfit._approximation._orthogonal import OrthogonalDistance
from jaxfit._approximation._sharded_fit import fit_sharded_cloud
from jaxfit._approximation._shards import divided_over
from jaxfit._checks import eager_where_concrete, with_whole_steps
from jaxfit._fit._adjoints import AbstractAdjoint
from jaxfit._fit._loop import Progress
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._result import Fit
from jaxfit._progress_line import shows_progress
from jaxfit._splines import BSplineSurface


@shows_progress("fitting a cloud")
@eager_where_concrete
def approximate(
    points: Any,
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
    adjoint: AbstractAdjoint | None = None,
) -> Fit:
    """Fit a surface with the net and the knots of `base` to a cloud of points.

    Parameters
    ----------
    points : array (points, d)
        In any order, any unit. Or what `jaxfit.io.read_points` has read.
    base : BSplineSurface
        A first approximation, for instance from `base_surface`. Its knots are kept; new ones are inserted
        only where the method has an `insertion`.
    method : GeometricApproximation(), OrthogonalDistance(), StandardApproximation() or your own, optional
        Any `AbstractIterativeMethod`. Default OrthogonalDistance(), which comes closest in the fewest
        iterations and makes no new folds; one of GeometricApproximation(), the paper's, takes a fraction of
        its time. The fit's `stats["method"]` is the name.
    tol_average : float or None
        The fit has converged when the average error is at most this fraction of the diagonal of the data's
        bounding box, and the maximum error at most `tol_maximum`. None sets no limit; not both may be None.
        With 0.0 a fit goes on until its errors stop falling: compare nets or methods so. Default: 6e-4, the
        paper's 0.06 %.
    tol_maximum : float or None
        The same of the maximum error (default None, no limit).
    max_steps : int
        The largest number of iterations (default 200).
    weights : array (points,), optional
        The non-negative weight of each point (default 1). Errors are not weighted.
    start : pair of arrays (points,), optional
        Feet (u, v) on the base surface to start from; default the closest points, searched globally. Where a
        cell has more than eight points and the method finds feet itself, some of them are searched for, and
        the others where one of these has a nearer foot elsewhere than beside the nearest sample.
    progress : callable, optional
        Called as `progress(step, max_steps, average, maximum)` every now and then, outside transformations;
        errors are fractions of the diagonal.
        Without it a line in the terminal (which takes rich) or the notebook says what is done, once that
        takes more than 3 s; ``off`` in the environment variable `JAXFIT_PROGRESS` shows none.
    throw : bool
        Raise a RuntimeError with the reason instead of returning a fit that has not converged.
    errors : GlobalFeet(), LocalFeet() or AtParameters(), optional
        Where the errors of the fit are measured (default GlobalFeet(), for every method): at true closest
        points, at local foot points, or at the parameters that the method ended with.
    adjoint : ImplicitAdjoint() or UnrolledAdjoint(), optional
        What the derivative of the fit is. By default that of the surface at which the method comes to rest,
        `ImplicitAdjoint()`, where the fit is differentiated. Passed explicitly, the surface is polished
        whether it is differentiated or not. `UnrolledAdjoint()` is the derivative of the iterations as they
        were run, for fits that stop early; `progress` is not called then.

    Returns
    -------
    Fit
        Its errors are measured as `errors` says. The iteration itself and its history use local feet. Outside
        transformations `stats` also hold the number of `points_beyond_border`, whose feet are on the border
        and which lie farther along the tangent plane there than across it, at four times the usual distance;
        and their share of the sum of all errors, `errors_beyond_border`.

    Raises
    ------
    ValueError
        If points, weights or start have the wrong shape or are not finite, start lies outside the domain,
        there are fewer than four points, all of them coincide, or no tolerance is given.

    Notes
    -----
    Section 4 of Kineri, Wang, Lin and Maekawa (2012). Runs under `jit` and `vmap`; on a CPU a batch is fitted
    one after the other. Outside transformations clouds are padded to one of four sizes per octave, so that a
    second cloud of similar size compiles nothing. `approximate_stream` fits clouds larger than
    memory.

    Fits are differentiable with respect to points, weights, the control points of `base`, and numbers of the
    method such as lambda. Control points of the base that move have the derivative 0: where the fit starts
    from does not matter to where it comes to rest. Those on a border that is held pass theirs on, and so does
    the boundary that they come from. Knots have none. With `UnrolledAdjoint` all control points of the base,
    and `start`, have the derivative of the fit as it was run. `ImplicitAdjoint` says when
    `stats["stationarity"]` permits to trust a derivative; inside `jit` that is NaN unless the fit is
    differentiated there.

    Points divided among the devices of a mesh (`shard_points`, also of several processes) are fitted where
    they are, by the three methods of this library: each device has the rows of its own points, and one to
    three sums of the size of the net go between devices in an iteration. u, v and errors stay divided.
    Closest points on the first and the last surface are searched by each process for its own points. Refused
    there: `adjoint`, `progress`, and what looks at all points together (knot insertion, local mode, a loss
    without a scale, a chosen lambda). Inside `jit` a divided cloud is gathered; inside your own
    `jax.shard_map` each device fits the clouds that it has.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 10), np.linspace(0, 1, 6), indexing="ij")
    >>> grid = np.stack([x, y, x * y], axis=2)
    >>> base = jf.base_surface(jf.Boundary.from_grid(grid), net=(6, 5))
    >>> points = grid.reshape(-1, 3) + 0.2 * np.sin(3 * x * y).reshape(-1, 1)
    >>> fit = jf.approximate(points, base, max_steps=3)
    >>> fit.surface.shape, fit.errors.shape, bool(fit.history.average[-1] < fit.history.average[0])
    ((6, 5), (60,), True)
    >>> print(fit.message)
    the maximum number of iterations was reached before the tolerances were met; ...
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
        "adjoint": adjoint,
    }
    points = getattr(points, "cloud", points)
    fit = fit_cloud if divided_over(points) is None else fit_sharded_cloud
    return fit(points, base, default_method(method), with_whole_steps(request))


def default_method(method: AbstractIterativeMethod | None) -> AbstractIterativeMethod:
    """The method, or the default one for None."""
    return OrthogonalDistance() if method is None else method
