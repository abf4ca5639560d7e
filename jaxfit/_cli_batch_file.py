"""The function of one file of `jaxfit batch`: what a worker runs, on this machine or another."""

import argparse
import contextlib
import json
import os
import warnings
import zipfile
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit import io
from jaxfit._cli_fit import FitOfFile, fitted_surface, read
from jaxfit._cli_methods import OPTIONS as METHOD_OPTIONS
from jaxfit._cli_output import as_sentence
from jaxfit._cli_session import choose_precision, set_compile_cache
from jaxfit._cli_table import FAILED, FITTED, MISSED, Row
from jaxfit._fit._summary import left_out
from jaxfit._precision import bucket

_FIT_OPTIONS = (
    *"net order method grid tol_average tol_maximum max_steps hole_length float32".split(),
    *METHOD_OPTIONS,
)
_FILES = ("boundary", "normals")
_SETTINGS = "cache no_cache quiet".split()


class Job(NamedTuple):
    """A file to fit. Everything in it is plain, so that it goes to another process."""

    arguments: dict[str, Any]  # as of `jaxfit fit`
    row: Row  # what the table says about the job before it is done


def job_of(args: argparse.Namespace, name: str) -> Job:
    """The job of the input `name`, by absolute paths."""
    path = os.path.abspath(name)
    arguments = {key: getattr(args, key) for key in (*_FIT_OPTIONS, *_SETTINGS)}
    for key in (*_FILES, "cache"):
        if arguments[key] is not None:
            arguments[key] = os.path.abspath(arguments[key])
    given = {key: arguments[key] for key in _FIT_OPTIONS if arguments[key] not in (None, False)}
    for key in _FILES:
        if arguments[key] is not None:
            given[key] += " " + size_and_time_of(arguments[key])
    surface = f"{Path(path).stem}.npz"
    arguments |= {"input": path, "output": os.path.abspath(os.path.join(args.output, surface))}
    row = {
        "input": path,
        "size_and_time": size_and_time_of(path),
        "options": json.dumps(given),
        "surface": surface,
    }
    return Job(arguments, row)


def size_and_time_of(path: str) -> str:
    """Size and time of a file; empty where there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return ""
    return f"{status.st_size} {status.st_mtime_ns}"


def fit_file(job: Job) -> Row:
    """The finished row of a job, whose surface is then written. What goes wrong is a sentence in the row."""
    args = argparse.Namespace(**job.arguments)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what matters is in the row
            _set_compile_cache_once(*(job.arguments[key] for key in _SETTINGS))
            choose_precision(args)
            return job.row | _fitted(args)
    except (ValueError, TypeError, OSError, ImportError) as error:  # an extra may be missing
        return failed(job, error)
    except Exception as error:  # whatever it is, the other files go on
        return failed(job, f"the fit failed: {error or type(error).__name__}")


def failed(job: Job, sentence: object) -> Row:
    """The row of a job that failed. It has no surface, and one of an earlier run goes."""
    with contextlib.suppress(OSError):
        os.unlink(job.arguments["output"])
    return job.row | {"status": FAILED, "error": as_sentence(sentence), "surface": None}


def _fitted(args: argparse.Namespace) -> Row:
    data, args = read(args)
    done = FitOfFile(args, data).run()
    fit = done.fit
    io.write_surface(args.output, fitted_surface(fit))
    return {
        "status": FITTED if done.reached else MISSED,
        "error": None,
        "points": len(data.cloud),
        "method": str(fit.stats.get("method", done.method)),
        "left_out": sum(left_out(fit).values()),
        "net": "{}x{}".format(*fit.surface.shape),
        "order": "{}x{}".format(*fit.surface.order),
        "iterations": int(fit.stats["num_steps"]),
        "average_error_percent": 100 * done.average,
        "maximum_error_percent": 100 * done.maximum,
        "folds": fit.folds,
        "message": done.message,
        "seconds": round(done.seconds, 3),
    }


@cache
def _set_compile_cache_once(*settings: Any) -> None:
    set_compile_cache(argparse.Namespace(**dict(zip(_SETTINGS, settings, strict=True))))


def size_of(job: Job) -> int | None:
    """What jobs share that share their programs: the bucket of their number of points, or about that.

    None where the file says nothing. Only the headers of arrays are read; of text, only its length.
    """
    path = Path(job.arguments["input"])
    try:
        if path.suffix.lower() == ".npz":
            with zipfile.ZipFile(path) as archive:
                names = set(archive.namelist())
                name = next(x for x in ("grid.npy", "points.npy") if x in names)
                with archive.open(name) as file:
                    return bucket(int(np.prod(_shape(file)[:-1])))
        if path.suffix.lower() == ".npy":
            with path.open("rb") as file:
                return bucket(int(np.prod(_shape(file)[:-1])))
        return -bucket(path.stat().st_size)
    except (OSError, ValueError, StopIteration, zipfile.BadZipFile):
        return None


def _shape(file: Any) -> tuple[int, ...]:
    version = np.lib.format.read_magic(file)
    reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return reader(file)[0]
