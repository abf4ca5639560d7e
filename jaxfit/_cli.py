"""The command `jaxfit`: a file of points in, a fitted surface and a picture out."""

import argparse
import importlib.util
import math
import os
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

import jaxfit
from jaxfit import io
from jaxfit._checks import check_magnitude
from jaxfit._cli_arguments import argument_parser
from jaxfit._cli_report import print_table, progress_bar

REACHED, NOT_REACHED, BAD_INPUT, FAILED, INTERRUPTED = 0, 1, 2, 3, 130

_PICTURES = (".png", ".pdf", ".svg", ".jpg")
_LARGEST_INTERPOLATION = 40_000  # grid points, for --method auto
_TERRAIN = "jacksboro"
_TERRAIN_NET = (62, 57)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (default: that of the process) and return its exit code.

    Switches JAX to double precision unless told ``--float32``. What goes wrong is one sentence
    on stderr; the codes are those in ``jaxfit fit --help``.
    """
    started = time.perf_counter()
    try:
        args = argument_parser().parse_args(argv)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what matters is in the table; --float32 was asked for
            return _fit_command(args, started)
    except KeyboardInterrupt:
        _complain("interrupted, nothing more is written.", INTERRUPTED)
        if argv is None:
            # A computation may still be running, and taking the interpreter down under it crashes.
            sys.stderr.flush()
            os._exit(INTERRUPTED)
        return INTERRUPTED
    except (ValueError, TypeError, OSError) as error:
        return _complain(error, BAD_INPUT)
    except (RuntimeError, ArithmeticError, MemoryError) as error:
        return _complain(f"the fit failed: {error or type(error).__name__}", FAILED)


def _complain(sentence: object, code: int) -> int:
    print("jaxfit: error:", " ".join(str(sentence).split()), file=sys.stderr)
    return code


def _fit_command(args: argparse.Namespace, started: float) -> int:
    jax.config.update("jax_enable_x64", not args.float32)
    picture = _check_files(args)
    data = _read(args)
    method = _choose_method(args, data)
    boundary = _choose_boundary(args, data) if method == "approximate" else None
    with progress_bar(show=not args.quiet and sys.stderr.isatty()) as progress:
        before = time.perf_counter()
        fit = _fit(args, method, data, boundary, progress)
        average, maximum = float(fit.average_error), float(fit.maximum_error)
        seconds = time.perf_counter() - before
    if not (math.isfinite(average) and math.isfinite(maximum)):
        return _complain(f"the fit failed: {fit.message}", FAILED)
    io.write_surface(args.output, fit.surface)
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
                "net": "{} x {}".format(*fit.surface.shape),
                "order": "{} x {}".format(*fit.surface.order),
                "method": f"{method}, {'single' if args.float32 else 'double'} precision",
                "iterations": str(int(fit.stats["num_steps"])),
                "average error": f"{100 * average:.4g} % of the diagonal",
                "maximum error": f"{100 * maximum:.4g} % of the diagonal",
                "stopped": fit.message,
                "time": f"fit {seconds:.2f} s, total {total:.2f} s",
                "written": ", ".join(str(path) for path in (args.output, picture) if path),
            }
        )
    return REACHED if _reached(args, method, fit, average, maximum) else NOT_REACHED


def _check_files(args: argparse.Namespace) -> str | None:
    """Refuse now what cannot be written later; return the picture's path, if there is to be one."""
    io.check_output(args.output)
    for name in filter(None, (args.input, args.boundary)):
        if os.path.exists(name) and os.path.realpath(name) == os.path.realpath(args.output):
            raise io.InputError(f"the output {args.output} is the file that is read; give it another name.")
    if args.no_picture:
        return None
    drawable = importlib.util.find_spec("matplotlib") is not None
    if args.picture is None:
        return str(Path(args.output).with_suffix(".png")) if drawable else None
    if not drawable:
        raise io.InputError(
            "a picture needs Matplotlib, which is not installed; pip install 'jaxfit-surfaces[plot]'."
        )
    io.check_output(args.picture, _PICTURES)
    return args.picture


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
    return count if data.grid is None else "{} (grid {} x {})".format(count, *data.grid.shape)
