"""The arguments of the command `jaxfit`, and its help."""

import argparse
import math
import re
from typing import Any, NoReturn

from jaxfit import __version__
from jaxfit._checks import LEAST_ORDER, MOST_ORDER
from jaxfit._cli_methods import add_method_options
from jaxfit.io import InputError

_MOST_STEPS = 1_000_000  # of which the errors are kept
_DESCRIPTION = """\
Fit a B-spline surface to INPUT and write it to OUTPUT.

INPUT   .npz  'grid' (n, m, 3), or 'points' (N, 3) with 'boundary_v0', 'boundary_v1',
              'boundary_u0', 'boundary_u1' (polylines)
        .npy  (n, m, 3) grid or (N, 3) scattered points
        .csv .xyz .txt  scattered points, one x y z a line
        .ply .stl .obj .off .las .laz .e57 .pcd  scattered points or the vertices of a mesh
        jacksboro       the terrain inside Matplotlib
OUTPUT  .npz  control_points, knots_u, knots_v, order; loops of a trimmed surface
        .json geomdl's exchange format
        .step .stp .iges .igs  for CAD, trimmed where the rim was found
        .3dm  for Rhino: the whole surface, and as curves the rim and the holes that were found
        .ply .stl .obj  triangles
"""
_EPILOG = """\
exit codes:
  0  fitted and written
  1  written, but a tolerance that was given was not reached (a missed default shows in the table only)
  2  bad input or usage, or a file cannot be written
  3  the fit failed numerically, nothing is written; or jaxfit has a defect, which a traceback shows
  130  interrupted, nothing more is written

environment:
  JAXFIT_CACHE_DIR  as --cache; empty or "off" is --no-cache
  JAXFIT_PROGRESS   "off" shows no progress: neither a line on a terminal nor one each minute in a log

All errors are distances from the data to the surface, in % of the diagonal of the data's
bounding box.
"""
_BATCH_DESCRIPTION = """\
Fit a B-spline surface to each FILE. FOLDER then holds NAME.npz for each NAME.*, and a row for each
file in table.csv and table.jsonl: errors, net, folds, or the sentence of what was wrong. A file that
cannot be fitted is passed over. Files whose row is there, made with the same options from the same
file, are not fitted again, so a run that was interrupted goes on where it stopped.
"""
_BATCH_EPILOG = """\
exit codes:
  0  all files fitted
  1  all fitted, but a tolerance that was given was not reached by some
  2  bad usage, or the folder cannot be written
  3  some files failed: their rows and stderr say why
  130  interrupted; the table has the files that were done

With --scheduler the workers read FILES and write FOLDER under the same paths, and have jaxfit.
"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help.")

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Name the command whose help lists what it takes, where there is an argument that it does not."""
        known, unknown = self.parse_known_args(args, namespace)
        if unknown:
            raise InputError(
                f"unrecognized arguments: {' '.join(unknown)}; see {self.prog} {known.command} --help."
            )
        return known


def argument_parser() -> argparse.ArgumentParser:
    """The parser of `jaxfit`; what it cannot read raises `InputError`."""
    parser = _Parser(prog="jaxfit", description="B-spline surfaces through points, in JAX.")
    parser.add_argument("--version", action="version", version=f"jaxfit {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_fit(commands)
    _add_batch(commands)
    return parser


def _add_fit(commands: Any) -> None:
    fit = commands.add_parser(
        "fit",
        help="fit a surface to a file of points",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    fit.add_argument("input", metavar="INPUT", help="the points, see above")
    fit.add_argument("-o", "--output", metavar="OUTPUT", required=True, help="the surface")
    _add_fit_options(fit)
    picture = fit.add_mutually_exclusive_group()
    picture.add_argument("--picture", metavar="FILE", help="surface and errors (default: OUTPUT with .png)")
    picture.add_argument("--no-picture", action="store_true", help="draw nothing")
    fit.add_argument("--report", metavar="FILE", help="a page of HTML: tables and pictures of the fit")
    fit.set_defaults(command="fit")


def _add_batch(commands: Any) -> None:
    batch = commands.add_parser(
        "batch",
        help="fit a surface to each of many files",
        description=_BATCH_DESCRIPTION,
        epilog=_BATCH_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    batch.add_argument("inputs", metavar="FILE", nargs="+", help="points, as for jaxfit fit")
    batch.add_argument("-o", "--output", metavar="FOLDER", required=True, help="surfaces and table; is made")
    where = batch.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=_workers, metavar="N", default=1, help="processes of this machine (default 1)"
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="fit on the workers of this Dask scheduler")
    batch.add_argument("--retry-failed", action="store_true", help="fit again what failed in an earlier run")
    _add_fit_options(batch)
    batch.set_defaults(command="batch")


def _add_fit_options(parser: argparse.ArgumentParser) -> None:
    """What a single fit and each of many can be told."""
    parser.add_argument("--net", type=_pair, metavar="NUxNV", help="number of control points")
    parser.add_argument(
        "--order", type=_order, metavar="KxL", default=(4, 4), help="degree + 1 (default 4x4); 3 is 3x3"
    )
    add_method_options(parser)
    parser.add_argument(
        "--grid", type=_pair, metavar="NxM", help="read scattered points as a grid, row by row"
    )
    parser.add_argument(
        "--boundary",
        metavar="FILE",
        help=".npz with the four border polylines of points; without, their rim is found",
    )
    parser.add_argument(
        "--hole-length",
        type=_length,
        metavar="L",
        help="without a boundary, in the unit of the points: wider gaps are holes (default: from spacing)",
    )
    for which in ("average", "maximum"):
        parser.add_argument(
            f"--tol-{which}",
            type=_percent,
            metavar="PCT",
            help=f"stop at this {which} error, in %%",
        )
    parser.add_argument("--max-steps", type=_count, metavar="N", help="stop after this many steps")
    cache = parser.add_mutually_exclusive_group()
    cache.add_argument(
        "--cache", metavar="DIR", help="keep compiled programs there (default: the user's cache folder)"
    )
    cache.add_argument("--no-cache", action="store_true", help="keep no compiled programs")
    parser.add_argument("--float32", action="store_true", help="single precision")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _pair(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no pair of counts such as 8x6")
    return int(match[1]), int(match[2])


def _order(text: str) -> tuple[int, int]:
    order = (int(text), int(text)) if re.fullmatch(r"\d{1,2}", text, re.ASCII) else _pair(text)
    if not all(LEAST_ORDER <= k <= MOST_ORDER for k in order):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no order; pass {LEAST_ORDER} to {MOST_ORDER} along u and v, such as 4x3, or 4 for "
            "both"
        )
    return order


def _percent(text: str) -> float:
    try:
        value = float(text.removesuffix("%"))
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no percentage such as 0.02")
    if value > 100:
        raise argparse.ArgumentTypeError(f"{text!r} is more than 100 %, the diagonal; pass one such as 0.06")
    return value


def _length(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no length such as 2.5")
    return value


def _workers(text: str) -> int:
    if not re.fullmatch(r"[1-9]\d{0,2}", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of processes such as 2")
    return int(text)


def _count(text: str) -> int:
    if not re.fullmatch(r"\d*[1-9]\d*", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of steps such as 100")
    if len(text) > len(str(_MOST_STEPS)) or int(text) > _MOST_STEPS:
        raise argparse.ArgumentTypeError(f"{text:.12} is too large, pass at most {_MOST_STEPS:,}")
    return int(text)
