"""Methods of the command line: each option is a field of the method object that it names."""

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np

import jaxfit
from jaxfit.io import InputError
from jaxfit.io._arrays import load_arrays
from jaxfit.io._points import check_input

_INTERPOLATING: dict[str, Any] = {
    "interpolate": jaxfit.GeometricInterpolation,
    "interpolate-standard": jaxfit.StandardInterpolation,
}
_APPROXIMATING: dict[str, Any] = {
    "approximate": jaxfit.OrthogonalDistance,  # the default of `approximate`
    "orthogonal": jaxfit.OrthogonalDistance,
    "geometric": jaxfit.GeometricApproximation,
    "standard": jaxfit.StandardApproximation,
}
METHODS = ("auto", *_INTERPOLATING, *_APPROXIMATING)
_SMOOTHING: dict[str, Any] = {"regular": jaxfit.RegularSmoothing, "gcv": jaxfit.GeneralizedCrossValidation}
_LOSSES: dict[str, Any] = {"huber": jaxfit.Huber, "tukey": jaxfit.Tukey, "geman-mcclure": jaxfit.GemanMcClure}
_BORDERS: dict[str, Any] = {
    "fixed": jaxfit.FixedBorder,
    "corners": jaxfit.FixedCorners,
    "free": jaxfit.FreeBorder,
}
_BASES: dict[str, Any] = {
    "coons": jaxfit.Coons,
    "meshless": jaxfit.Meshless,
    "dynamic": jaxfit.DynamicBaseSurface,
}
_ROWS = {"rows": 0, "columns": 1}
_OF_CLOUDS = ("smoothing", "loss", "insertion", "border", "base", "boundary")
_OF_GRIDS = ("symmetry", "normals")
OPTIONS = (*_OF_CLOUDS, *_OF_GRIDS)


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """How the surface is fitted."""
    parser.add_argument(
        "--method",
        choices=METHODS,
        metavar="METHOD",
        default="auto",
        help="interpolate or interpolate-standard (grids); orthogonal, geometric or standard; approximate is "
        "orthogonal. auto (default) interpolates grids of up to 40,000 points unless --net or an option of "
        "the others is given, and approximates everything else",
    )
    parser.add_argument(
        "--smoothing",
        type=_smoothing,
        metavar="LAMBDA",
        help="weight of the thin plate (orthogonal, standard), 'regular' (orthogonal) or 'gcv' (standard)",
    )
    parser.add_argument("--loss", choices=_LOSSES, help="outliers count less")
    parser.add_argument("--insertion", action="store_true", help="insert knots where errors are greatest")
    parser.add_argument("--border", choices=_BORDERS, help="which border control points stay (default fixed)")
    parser.add_argument("--base", choices=_BASES, help="how the base surface is made")
    parser.add_argument(
        "--symmetry", choices=_ROWS, help="of an interpolated grid: which of the two are mirrored"
    )
    parser.add_argument(
        "--normals", metavar="FILE", help="of an interpolated grid: .npy or .npz with 'normals' (n, m, 3)"
    )


def interpolates(method: str) -> bool:
    """Whether it is a method of grids; not of `auto`."""
    return method in _INTERPOLATING


def asks_for_cloud(args: argparse.Namespace) -> bool:
    """Whether an option is given that only approximating methods have."""
    return bool(_given(args, _OF_CLOUDS))


def asks_for_grid(args: argparse.Namespace) -> bool:
    """Whether an option is given that only interpolating methods have."""
    return bool(_given(args, _OF_GRIDS))


def fit_options(args: argparse.Namespace, method: str) -> dict[str, Any]:
    """What `jaxfit.interpolate` or `jaxfit.fit_points` is told of `method`, base and normals.

    Raises
    ------
    InputError
        If the method has no such option, or the normals cannot be read.
    """
    foreign = _given(args, _OF_CLOUDS if interpolates(method) else _OF_GRIDS)
    if foreign:
        remedy = "approximate" if interpolates(method) else "interpolate"
        raise InputError(
            f"--{foreign[0]} is no option of --method {method}; leave it out, or use --method {remedy}."
        )
    return _of_grids(args, method) if interpolates(method) else _of_clouds(args, method)


def _given(args: argparse.Namespace, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if getattr(args, name) not in (None, False)]


def _of_grids(args: argparse.Namespace, method: str) -> dict[str, Any]:
    options: dict[str, Any] = {}
    if args.normals is not None:
        if method != "interpolate" or args.symmetry:
            raise InputError(
                "--normals has a method of its own; leave out --symmetry, and use --method interpolate."
            )
        options["normals"] = _read_normals(args.normals)
    if args.symmetry:
        if method != "interpolate":
            raise InputError(f"--symmetry is no option of --method {method}; use --method interpolate.")
        symmetry = jaxfit.Reflection(axis=_ROWS[args.symmetry])
        options["method"] = jaxfit.GeometricInterpolation(symmetry=symmetry)
    elif method != "interpolate":
        options["method"] = _INTERPOLATING[method]()
    return options


def _of_clouds(args: argparse.Namespace, method: str) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    if args.smoothing is not None:
        fields["smoothing"] = _checked_smoothing(args.smoothing, method)
    if args.loss:
        fields["loss"] = _LOSSES[args.loss]()
    if args.insertion:
        fields["insertion"] = jaxfit.KnotInsertion()
    if args.border:
        fields["border"] = _BORDERS[args.border]()
    options: dict[str, Any] = {"base": _BASES[args.base]()} if args.base else {}
    if fields or method != "approximate":
        options["method"] = _APPROXIMATING[method](**fields)
    return options


def _checked_smoothing(smoothing: str | float, method: str) -> Any:
    if method == "geometric":
        raise InputError("--smoothing is no option of --method geometric; use --method orthogonal.")
    if not isinstance(smoothing, str):
        return smoothing
    wanted = "standard" if smoothing == "gcv" else "orthogonal"
    if (method == "standard") != (wanted == "standard"):
        raise InputError(f"--smoothing {smoothing} is one of --method {wanted}; give that, or a number.")
    return _SMOOTHING[smoothing]()


def _smoothing(text: str) -> str | float:
    if text in _SMOOTHING:
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number such as 1e-9 nor 'regular' nor 'gcv'")
    return value


def _read_normals(name: str) -> np.ndarray:
    path = Path(name)
    check_input(path, (".npz", ".npy"))
    arrays, _ = load_arrays(path, ("normals",))
    found = arrays.get("array", arrays.get("normals"))
    if found is None:
        raise InputError(f"{path} holds no normals; store an array 'normals' of shape (n, m, 3) in it.")
    return found
