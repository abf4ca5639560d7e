"""The fit of one file, as the arguments of the command ask for it."""

import argparse
import dataclasses
import inspect
import math
import os
import time
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jaxfit
from jaxfit import io
from jaxfit._checks import check_magnitude
from jaxfit._cli_methods import asks_for_cloud, asks_for_grid, fit_options, interpolates
from jaxfit._cli_output import as_sentence
from jaxfit._scan import is_nodata

TERRAIN = "jacksboro"
_TERRAIN_NET = (62, 57)
_LARGEST_INTERPOLATION = 40_000  # grid points, for --method auto


class FittedFile(NamedTuple):
    """A fit whose errors are finite, its errors as fractions of the diagonal, whether these will do, the
    tolerances in force, and why the fit stopped.
    """

    fit: Any
    method: str
    average: float
    maximum: float
    seconds: float
    reached: bool
    tolerances: str
    message: str


def read(args: argparse.Namespace) -> tuple[io.PointData, argparse.Namespace]:
    """The points of ``args.input``, and the arguments; for the terrain with its own method and net."""
    if args.input == TERRAIN:
        data, args = io.jacksboro(), _of_terrain(args)
    else:
        data = io.read_points(args.input)
        check_magnitude("points", data.cloud)
    data = data if args.grid is None else data.as_grid(*args.grid)
    as_cloud = data.grid is not None and not interpolates(args.method) and not asks_for_grid(args)
    if as_cloud and is_nodata(data.cloud).any():  # what is left is a scan
        data = dataclasses.replace(data, points=data.cloud, grid=None, boundary=None)
    return data, args


def _of_terrain(args: argparse.Namespace) -> argparse.Namespace:
    method = "approximate" if args.method == "auto" else args.method
    net = _TERRAIN_NET if args.net is None and not interpolates(method) else args.net
    return argparse.Namespace(**vars(args) | {"method": method, "net": net})


def read_and_written(arguments: Iterable[Mapping[str, Any]], written: Iterable[str]) -> str | None:
    """The first of the files `written` that is also one that fits with these `arguments` read, if any is;
    links are followed.
    """
    named = {x[name] for x in arguments for name in ("input", "boundary", "normals")} - {None}
    kept = {os.path.realpath(name) for name in named if os.path.exists(name)}
    return next((name for name in written if os.path.realpath(name) in kept), None)


def fitted_surface(fit: Any) -> Any:
    """What is written of a fit: its surface, trimmed where the fit has loops."""
    trimmed = getattr(fit, "trimmed", None)
    return fit.surface if trimmed is None else trimmed


class FitOfFile:
    """What is to be done with the points of a file; raises `InputError` if `args` cannot be met."""

    def __init__(self, args: argparse.Namespace, data: io.PointData):
        self.args, self.data = args, data
        self.method = _choose_method(args, data)
        self.options = fit_options(args, self.method)
        self.boundary = None if interpolates(self.method) else _choose_boundary(args, data)
        if args.hole_length is not None and (self.boundary is not None or interpolates(self.method)):
            has = "is a grid" if data.grid is not None else "has one"
            raise io.InputError(
                f"--hole-length is for points without a boundary, but {args.input} {has}; leave it out."
            )
        if args.base is not None and self.boundary is None and not interpolates(self.method):
            raise io.InputError(
                f"--base is for points with a boundary, but {args.input} has none; leave it out, or "
                "give one by --boundary."
            )

    def run(self) -> FittedFile:
        """Fit; raises ArithmeticError where the fit ends with errors that are not finite."""
        before = time.perf_counter()
        fit = self._fit()
        average, maximum = float(fit.average_error), float(fit.maximum_error)
        seconds = time.perf_counter() - before
        if not (math.isfinite(average) and math.isfinite(maximum)):
            raise ArithmeticError(fit.message)
        reached = self._reached(fit, average, maximum)
        said = self._tolerances(), self._message(fit)
        return FittedFile(fit, self.method, average, maximum, seconds, reached, *said)

    def _reached(self, fit: Any, average: float, maximum: float) -> bool:
        """Whether the errors will do. Without a requested tolerance every finite fit of a cloud does."""
        asked, errors = self._asked(), {"tol_average": average, "tol_maximum": maximum}
        if interpolates(self.method) and not asked:
            return bool(fit.converged)
        return all(errors[name] <= value / 100 for name, value in asked.items())

    def _message(self, fit: Any) -> str:
        """Why it stopped; where it folds, also whether the sides of the grid are the other way round."""
        said, (n, m) = as_sentence(fit.message), self.args.grid or (0, 0)
        if n == m or self.data.grid is None or not fit.regularity.folds:
            return said
        return f"{said.removesuffix('.')}, or is the grid {m}x{n}?"

    def _tolerances(self) -> str:
        """The tolerances in force, in per cent."""
        asked = self._asked()
        if interpolates(self.method):  # it bounds the maximum, and with it the average
            return f"maximum {min(asked.values()):g} %" if asked else "maximum at rounding (default)"
        default = inspect.signature(jaxfit.approximate).parameters["tol_average"].default
        said = f"{asked['tol_average']:g} %" if "tol_average" in asked else f"{100 * default:g} % (default)"
        most = asked.get("tol_maximum")
        return f"average {said}, maximum {'without limit' if most is None else f'{most:g} %'}"

    def _asked(self) -> dict[str, float]:
        """The tolerances that were given, in per cent."""
        given = {"tol_average": self.args.tol_average, "tol_maximum": self.args.tol_maximum}
        return {name: value for name, value in given.items() if value is not None}

    def _fit(self) -> Any:
        args, data = self.args, self.data
        options: dict[str, Any] = {"order": args.order, **self.options}
        if args.max_steps is not None:
            options["max_steps"] = args.max_steps
        tolerances = {name: value / 100 for name, value in self._asked().items()}
        if interpolates(self.method) and data.grid is not None:
            if tolerances:
                options["tolerance"] = min(tolerances.values())
            return jaxfit.interpolate(data.grid, **options)
        if self.boundary is None:
            options |= {"faces": data.faces, "hole_length": args.hole_length}
        return jaxfit.fit_points(data.cloud, self.boundary, net=args.net, **tolerances, **options)


def _choose_method(args: argparse.Namespace, data: io.PointData) -> str:
    if interpolates(args.method):
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
    if data.grid is not None and asks_for_grid(args):
        return "interpolate"
    small_grid = data.grid is not None and len(data.cloud) <= _LARGEST_INTERPOLATION
    return "interpolate" if small_grid and args.net is None and not asks_for_cloud(args) else "approximate"


def _choose_boundary(args: argparse.Namespace, data: io.PointData) -> Any:
    if args.boundary is not None:
        return io.read_boundary(args.boundary)
    if data.boundary is not None:
        return data.boundary
    if data.grid is not None:
        return jaxfit.Boundary.from_grid(data.grid)  # says what is wrong with its edges
    return None  # the rim of the points is found by the fit
