"""The command `jaxfit`: a file of points in, a fitted surface and a picture out."""

import argparse
import contextlib
import importlib.util
import math
import os
import sys
import threading
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

import jaxfit
from jaxfit import _interrupt, io
from jaxfit._checks import check_magnitude
from jaxfit._cli_arguments import argument_parser
from jaxfit._cli_cache import VARIABLE, cache_folder
from jaxfit._cli_report import print_table, progress_bar
from jaxfit._fit._summary import facts

REACHED, NOT_REACHED, BAD_INPUT, FAILED = 0, 1, 2, 3
INTERRUPTED = _interrupt.EXIT_CODE

_PICTURES = (".png", ".pdf", ".svg", ".jpg")
_LARGEST_INTERPOLATION = 40_000  # grid points, for --method auto
_TERRAIN = "jacksboro"
_TERRAIN_NET = (62, 57)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (default: that of the process) and return its exit code.

    Switches JAX to double precision unless told ``--float32``, and has it keep compiled programs unless told
    ``--no-cache``. What goes wrong is one sentence on stderr; the codes are those in ``jaxfit fit --help``.
    With the process's own arguments it ends the process.
    """
    code = _run(argv)
    if argv is None:
        # At once: taking the interpreter down costs a second, and crashes where a computation still runs.
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    return code


def _run(argv: Sequence[str] | None) -> int:
    started = time.perf_counter()
    try:
        _interrupt.restore_ctrl_c()
        args = argument_parser().parse_args(argv)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what matters is in the table; --float32 was asked for
            return _fit_command(args, started)
    except KeyboardInterrupt:
        return _fail("interrupted, nothing more is written.", INTERRUPTED)
    except (ValueError, TypeError, OSError) as error:
        return _fail(error, BAD_INPUT)
    except (RuntimeError, ArithmeticError, MemoryError) as error:
        return _fail(f"the fit failed: {error or type(error).__name__}", FAILED)


def _fail(sentence: object, code: int) -> int:
    print("jaxfit: error:", " ".join(str(sentence).split()), file=sys.stderr)
    return code


def _fit_command(args: argparse.Namespace, started: float) -> int:
    jax.config.update("jax_enable_x64", not args.float32)
    picture = _check_files(args)
    _set_compile_cache(args)
    data = _read(args)
    if picture:  # while the fit is compiled, which leaves Python idle
        threading.Thread(target=_load_matplotlib, daemon=True).start()
    method = _choose_method(args, data)
    boundary = _choose_boundary(args, data) if method == "approximate" else None
    with progress_bar(show=not args.quiet and sys.stderr.isatty()) as progress:
        before = time.perf_counter()
        fit = _fit(args, method, data, boundary, progress)
        average, maximum = float(fit.average_error), float(fit.maximum_error)
        seconds = time.perf_counter() - before
    if not (math.isfinite(average) and math.isfinite(maximum)):
        return _fail(f"the fit failed: {fit.message}", FAILED)
    offset = io.write_surface(args.output, fit.surface)
    if picture:
        from jaxfit.plot import surface_and_errors

        points = data.cloud if data.grid is None else data.grid
        surface_and_errors(fit, points, path=picture, title=data.name)
    if not args.quiet:
        total = time.perf_counter() - started
        print_table(
            {
                "input": args.input,
                "points": _describe(data),
                **facts(fit),
                "method": f"{method}, {'single' if args.float32 else 'double'} precision",
                "time": f"fit {seconds:.2f} s, total {total:.2f} s",
                "written": ", ".join(str(path) for path in (args.output, picture) if path),
                **({"offset": " ".join(map(repr, offset.tolist()))} if offset.any() else {}),
            }
        )
    return REACHED if _reached(args, method, fit, average, maximum) else NOT_REACHED


def _set_compile_cache(args: argparse.Namespace) -> None:
    """Have JAX keep what it compiles, where the user has not told JAX itself where to."""
    kept_by_jax = getattr(jax.config, "jax_compilation_cache_dir", None)
    if args.no_cache or (kept_by_jax and args.cache is None and VARIABLE not in os.environ):
        return
    try:
        folder = cache_folder(args.cache)
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home folder
        if not args.quiet:
            print(
                f"jaxfit: warning: compiled programs are not kept ({error}); give --cache DIR or --no-cache.",
                file=sys.stderr,
            )
        return
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # Small programs too: there are twenty of them, and each takes a tenth of a second.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _load_matplotlib() -> None:
    import matplotlib.backends.backend_agg  # noqa: F401


def _check_files(args: argparse.Namespace) -> str | None:
    """Refuse now what cannot be written later; return the picture's path, if there is to be one."""
    io.check_output(args.output)
    for name in filter(None, (args.input, args.boundary)):
        if os.path.exists(name) and os.path.realpath(name) == os.path.realpath(args.output):
            raise io.InputError(f"the output {args.output} is the file that is read; give it another name.")
    if args.no_picture:
        return None
    drawable = importlib.util.find_spec("matplotlib") is not None
    if not drawable and args.picture is not None:
        raise io.InputError(
            "a picture needs Matplotlib, which is not installed; pip install 'jaxfit-surfaces[plot]'."
        )
    if not drawable:
        return None
    picture = args.picture or str(Path(args.output).with_suffix(".png"))
    io.check_output(picture, _PICTURES)
    return picture


def _read(args: argparse.Namespace) -> io.PointData:
    if args.input == _TERRAIN:
        data = io.jacksboro()
        if args.method == "auto":
            args.method = "approximate"
        if args.method == "approximate" and args.net is None:
            args.net = _TERRAIN_NET
    else:
        data = io.read_points(args.input)
        check_magnitude("points", data.cloud)
    return data if args.grid is None else data.as_grid(*args.grid)


def _choose_method(args: argparse.Namespace, data: io.PointData) -> str:
    if args.method == "interpolate":
        if data.grid is None:
            raise io.InputError(
                f"{args.input} holds scattered points, which cannot be interpolated; use "
                "--method approximate, or --grid NxM if the points make a grid."
            )
        if args.net is not None:
            raise io.InputError(
                "the net of an interpolating surface is that of the data; leave out --net, or use "
                "--method approximate."
            )
    if args.method != "auto":
        return args.method
    small_grid = data.grid is not None and len(data.cloud) <= _LARGEST_INTERPOLATION
    return "interpolate" if small_grid and args.net is None else "approximate"


def _choose_boundary(args: argparse.Namespace, data: io.PointData) -> Any:
    if args.boundary is not None:
        return io.read_boundary(args.boundary)
    if data.boundary is not None:
        return data.boundary
    if data.grid is not None:
        return jaxfit.Boundary.from_grid(data.grid)  # says what is wrong with its edges
    raise io.InputError(
        f"{args.input} holds scattered points without a boundary; give the four border polylines "
        "with --boundary FILE.npz, or --grid NxM if the points make a grid."
    )


def _fit(args: argparse.Namespace, method: str, data: io.PointData, boundary: Any, progress: Any) -> Any:
    options: dict[str, Any] = {"order": args.order, "progress": progress}
    if args.max_steps is not None:
        options["max_steps"] = args.max_steps
    tolerances = {
        name: value / 100
        for name, value in (("tol_average", args.tol_average), ("tol_maximum", args.tol_maximum))
        if value is not None
    }
    if method == "interpolate" and data.grid is not None:
        if tolerances:
            # Interpolation bounds the maximum error, and with it the average.
            options["tolerance"] = min(tolerances.values())
        return jaxfit.interpolate(data.grid, **options)
    return jaxfit.fit_points(data.cloud, boundary, net=args.net, **tolerances, **options)


def _reached(args: argparse.Namespace, method: str, fit: Any, average: float, maximum: float) -> bool:
    if method == "interpolate" and args.tol_average is None and args.tol_maximum is None:
        return bool(fit.converged)
    # Without a requested tolerance every finite fit will do.
    return all(
        tolerance is None or error <= tolerance / 100
        for error, tolerance in ((average, args.tol_average), (maximum, args.tol_maximum))
    )


def _describe(data: io.PointData) -> str:
    count = f"{len(data.cloud):,}"
    notes = [] if data.grid is None else ["grid {} x {}".format(*data.grid.shape)]
    if data.left_out:
        reasons = (f"{count:,} {reason}" for reason, count in data.left_out.items())
        notes.append(f"left out: {', '.join(reasons)}")
    return f"{count} ({'; '.join(notes)})" if notes else count
