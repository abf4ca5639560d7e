"""The command `jaxfit`: a file of points in, a fitted surface and a picture out."""

import argparse
import contextlib
import importlib.util
import os
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path

from jaxfit import _interrupt, io
from jaxfit._cli_arguments import argument_parser
from jaxfit._cli_fit import FitOfFile, fitted_surface, read, read_and_written
from jaxfit._cli_output import as_sentence, print_table
from jaxfit._cli_report import write_page
from jaxfit._cli_session import choose_precision, set_compile_cache, trace_quickly
from jaxfit._fit._summary import facts
from jaxfit._progress_line import show_nothing, write_log
from jaxfit.io._output import PICTURES

REACHED, NOT_REACHED, BAD_INPUT, FAILED = 0, 1, 2, 3
INTERRUPTED = _interrupt.EXIT_CODE


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (default: that of the process) and return its exit code.

    Switches JAX to double precision unless told ``--float32``, and has it keep compiled programs unless told
    ``--no-cache``. What goes wrong is one sentence on stderr, after a traceback if it is a defect; the codes
    are those in ``jaxfit fit --help``.
    With the process's own arguments it ends the process.
    """
    if argv is None:
        _interrupt.last_calls.append(_interrupted)
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
        args = argument_parser().parse_args(argv)
        if args.quiet or args.command == "batch":  # which says what is done
            show_nothing()
        else:
            write_log()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what matters is in the table; --float32 was asked for
            if args.command == "batch":
                from jaxfit._cli_batch import batch_command

                return batch_command(args)
            return _fit_command(args, started)
    except KeyboardInterrupt:
        return _interrupted()
    except (ValueError, TypeError, OSError, ImportError) as error:  # an extra may be missing
        return _fail(error, BAD_INPUT)
    except (RuntimeError, ArithmeticError, MemoryError) as error:
        return _fail(f"the fit failed: {error or type(error).__name__}", FAILED)
    except Exception as error:  # else Python would end with the code of a tolerance that was missed
        traceback.print_exc()
        defect = f"{type(error).__name__}: {error}"
        return _fail(f"the fit failed; please report this defect with the lines above: {defect}", FAILED)


def _interrupted() -> int:
    return _fail("interrupted, nothing more is written.", INTERRUPTED)


def _fail(sentence: object, code: int) -> int:
    print("jaxfit: error:", as_sentence(sentence), file=sys.stderr)
    return code


def _fit_command(args: argparse.Namespace, started: float) -> int:
    choose_precision(args)
    trace_quickly()
    picture = _check_files(args)
    set_compile_cache(args)
    data, chosen = read(args)
    if picture:  # while the fit is compiled, which leaves Python idle
        threading.Thread(target=_load_matplotlib, daemon=True).start()
    done = FitOfFile(chosen, data).run()
    offset = io.write_surface(args.output, fitted_surface(done.fit))
    read_from = {"input": args.input, "points": _describe(data)}
    written = [args.output]

    def outcome(*more: str) -> dict[str, str]:
        method = done.fit.stats.get("method", done.method)
        return {
            "method": f"{method}, {'single' if args.float32 else 'double'} precision",
            "time": f"fit {done.seconds:.2f} s, total {time.perf_counter() - started:.2f} s",
            "written": ", ".join([*written, *more]),
            **({"offset": " ".join(map(repr, offset.tolist()))} if offset.any() else {}),
        }

    try:
        if picture:
            from jaxfit.plot import surface_and_errors

            points = data.cloud if data.grid is None else data.grid
            surface_and_errors(done.fit, points, path=picture, title=data.name)
            written.append(picture)
        if args.report:
            write_page(args, data, done, read_from, outcome(args.report))
            written.append(args.report)
    finally:  # the surface is there, whatever becomes of the others
        if not args.quiet:
            said = {"tolerances": done.tolerances, "stopped": done.message}
            print_table({**read_from, **facts(done.fit), **said, **outcome()})
    return REACHED if done.reached else NOT_REACHED


def _load_matplotlib() -> None:
    import matplotlib.backends.backend_agg  # noqa: F401


def _check_files(args: argparse.Namespace) -> str | None:
    """Refuse now what cannot be written later; return the picture's path, if there is to be one."""
    io.check_output(args.output)
    if read_and_written([vars(args)], [args.output]):
        raise io.InputError(f"the output {args.output} is the file that is read; give it another name.")
    drawable = importlib.util.find_spec("matplotlib") is not None
    if args.report:
        io.check_output(args.report, (".html", ".htm"))
    if args.no_picture and (drawable or not args.report):
        return None
    if not drawable and (args.picture is not None or args.report):
        raise io.InputError(
            'pictures need Matplotlib, which is not installed; pip install "jaxfit-surfaces[plot]".'
        )
    if not drawable:
        return None
    picture = args.picture or str(Path(args.output).with_suffix(".png"))
    io.check_output(picture, PICTURES)
    return picture


def _describe(data: io.PointData) -> str:
    count = f"{len(data.cloud):,}"
    notes = [] if data.grid is None else ["grid {} x {}".format(*data.grid.shape)]
    if data.left_out:
        reasons = (f"{count:,} {reason}" for reason, count in data.left_out.items())
        notes.append(f"without {', '.join(reasons)}")
    return f"{count} ({'; '.join(notes)})" if notes else count
