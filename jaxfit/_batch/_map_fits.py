"""`map_fits`: `approximate` for many clouds, base surfaces or methods."""

import inspect
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

import jax
from jax.typing import ArrayLike

from jaxfit._approximation import approximate
from jaxfit._approximation._checked_arguments import check_options, checked_request
from jaxfit._approximation._cloud_fit import LEAST_POINTS
from jaxfit._batch._broadcast import Request, one_by_one, requests_of
from jaxfit._batch._failed_fit import failed_fit
from jaxfit._checks import as_points, check_kind, is_concrete, with_whole_steps
from jaxfit._cores import cores
from jaxfit._fit._method import AbstractIterativeMethod
from jaxfit._fit._result import Fit, converged_or_raise
from jaxfit._precision import bucket, working_dtype
from jaxfit._progress_line import doing, shows_progress
from jaxfit._splines import BSplineSurface

# A worker gets so many fits at a time, or one in so many of those left: towards the end one by one, so that
# no worker waits long for the others.
_LARGEST_GROUP, _ONE_IN = 16, 16


@shows_progress("fitting clouds")
def map_fits(
    clouds: Any,
    base: BSplineSurface | Sequence[BSplineSurface],
    method: AbstractIterativeMethod | Sequence[AbstractIterativeMethod] | None = None,
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    executor: Any = None,
    throw: bool = False,
    **options: Any,
) -> tuple[Fit, ...]:
    """The fits of many clouds, from many base surfaces or by many methods, side by side.

    Fit i is `approximate(clouds[i], base[i], method[i], weights=weights[i], **options)`. What is given once
    is shared by all. A cloud that cannot be fitted fails alone (NaN in it, too few points or coordinates,
    points that all coincide, weights that are negative or too few): its fit has not converged, and says why,
    and its surface is the base. The other fits are the same to the bit.

    Parameters
    ----------
    clouds : list of arrays (points, d), array (fits, points, d), or one array (points, d)
        They may differ in size. Each may be what `jaxfit.io.read_points` has read.
    base : BSplineSurface, or a list of them
    method : one of those of approximate, or a list of them, optional
        So are lambdas given: ``[jf.StandardApproximation(smoothing=x) for x in lambdas]``.
    weights : list of arrays (points,), array (fits, points), or one array (points,), optional
    executor : concurrent.futures.Executor, optional
        Who computes. Default: threads of this process, one for each core. `worker_processes(2)` has processes
        that hundreds of fits pay for; that of a Dask client has machines.
    throw : bool
        Raise a RuntimeError for the first fit that has not converged, once all are done.
    options
        As for `approximate`: tol_average, tol_maximum, max_steps, errors, adjoint. The same for all.

    Returns
    -------
    tuple of Fit

    Raises
    ------
    ValueError, TypeError
        Before anything is computed: for options and methods, as `approximate` does; for a cloud or weights
        that hold no numbers, with its number; if the lists differ in length, or nothing is a list.

    Notes
    -----
    On a CPU a fit is a loop of small steps that a second core hardly helps, and much of a short fit is
    Python, of which one thread runs at a time. So threads gain most where fits are long, and processes
    always. The fits of one program (`jax.lax.map`, or `jax.vmap`, which runs one after the other on a CPU)
    cannot use a second core, and compile for longer. Clouds of a few hundred points are fitted faster in a
    loop over a jitted function, whose errors are at local feet: most of the time goes into what is done
    before and after the iteration there, above all the search for global feet. Inside `jit`, `vmap` or `grad`
    this is `jax.lax.map`, clouds must have one size (`pad_clouds`), and `executor` is not used.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 10), np.linspace(0, 1, 6), indexing="ij")
    >>> grid = np.stack([x, y, x * y], axis=2)
    >>> base = jf.base_surface(jf.Boundary.from_grid(grid), net=(6, 5))
    >>> cloud = grid.reshape(-1, 3) + 0.2 * np.sin(3 * x * y).reshape(-1, 1)
    >>> fits = jf.map_fits([cloud, cloud[::2], np.nan * cloud], base, max_steps=3)
    >>> [len(fit.u) for fit in fits], bool(fits[2].converged)
    ([60, 30, 60], False)
    """
    options = with_whole_steps(options)
    requests = requests_of(clouds, base, method, weights)
    _check_names(options)
    if executor is not None:
        check_kind("executor", executor, Executor, "worker_processes(2)")
    if not is_concrete(requests, options):
        traced = one_by_one(lambda request: _fit(request, options), requests)
        return _raised(traced) if throw else tuple(traced)
    refused = [_refused(i, request, options) for i, request in enumerate(requests)]
    fitted = iter(_run([x for x, why in zip(requests, refused, strict=True) if not why], executor, options))
    fits = tuple(
        failed_fit(request, {**_OPTIONS, **options}, why) if why else next(fitted)
        for request, why in zip(requests, refused, strict=True)
    )
    return _raised(fits) if throw else fits


def _fit(request: Request, options: dict[str, Any]) -> Fit:
    return approximate(request.cloud, request.base, request.method, weights=request.weights, **options)


def _fit_group(requests: list[Request], options: dict[str, Any]) -> list[Fit]:
    """What a worker does. The fits are computed when it returns."""
    return jax.block_until_ready([_fit(request, options) for request in requests])


def _run(requests: list[Request], executor: Executor | None, options: dict[str, Any]) -> list[Fit]:
    if executor is not None:
        _check_precision(executor)
        return _in_groups(requests, executor, options, _LARGEST_GROUP)
    threads = cores() if jax.default_backend() == "cpu" else 1
    # The first fit of each size alone: threads that come upon a new program each compile it.
    sizes = [(bucket(len(x.cloud)), x.base.shape, type(x.method)) for x in requests]
    leading = [sizes.index(size) == i for i, size in enumerate(sizes)]
    first = iter(_fit_group([x for x, leads in zip(requests, leading, strict=True) if leads], options))
    others = [x for x, leads in zip(requests, leading, strict=True) if not leads]
    with ThreadPoolExecutor(threads) as pool:
        same = pool.submit(working_dtype).result() == working_dtype()  # which may be switched for one thread
        rest = iter(_in_groups(others, pool, options, 1) if same else _fit_group(others, options))
    return [next(first if leads else rest) for leads in leading]


def _in_groups(requests: list[Request], executor: Executor, options: dict[str, Any], most: int) -> list[Fit]:
    futures, left = [], requests
    while left:
        size = min(most, -(-len(left) // _ONE_IN))
        futures.append(executor.submit(_fit_group, left[:size], options))
        left = left[size:]
    fits: list[Fit] = []
    try:
        for future in futures:
            doing(f"fitting clouds, {len(fits)} of {len(requests)}")
            fits += future.result()
        return fits
    finally:
        for future in futures:
            future.cancel()


def _check_precision(executor: Executor) -> None:
    there = executor.submit(working_dtype).result()
    if there != working_dtype():
        raise ValueError(
            f"executor must compute in {working_dtype()} like this session, but has {there}; set "
            "JAX_ENABLE_X64 in the environment of its processes, or use worker_processes."
        )


def _raised(fits: Sequence[Fit]) -> tuple[Fit, ...]:
    return tuple(converged_or_raise(fit) for fit in fits)


def _refused(index: int, request: Request, options: dict[str, Any]) -> str:
    """Why the points or weights of a request can't be fitted, in the words of `approximate`, "" if they can.

    What is no matter of one cloud's numbers is raised.
    """
    try:
        check_options(request.method, progress=None, throw=False, **{**_OPTIONS, **options})
        try:
            cloud = as_points("points", request.cloud, request.base.dimension, least=LEAST_POINTS)
            checked_request(cloud, request.base.domain, weights=request.weights)
        except ValueError as error:
            return str(error)
    except (ValueError, TypeError) as error:
        raise type(error)(f"clouds[{index}]: {error}") from error
    return ""


def _check_names(options: dict[str, Any]) -> None:
    for name in options:
        if name not in _OPTIONS:
            raise TypeError(f"{name} is not an option of map_fits; pass any of {', '.join(_OPTIONS)}.")


_OPTIONS = {
    name: parameter.default
    for name, parameter in inspect.signature(approximate).parameters.items()
    if name not in ("points", "base", "method", "weights", "start", "progress", "throw")
}
