"""All benchmarks as one program.

    python -m benchmarks                      # what there is
    python -m benchmarks paper peers          # run suites
    python -m benchmarks paper --only table5 --json paper.json --markdown paper.md

Times are medians after a first call, which compiles, with the lowest and the highest. Every timed fit is
judged by true closest points and folds, by SciPy alone. A study takes its own options, see
`python -m benchmarks streams --help`.
"""

import argparse
import importlib
import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

SUITES = {
    "paper": "Tables 1 to 5, Figures 1, 2, 4b, 7, 8 and 10 and the local mode of the paper",
    "peers": "beside SciPy, CHOLMOD, geomdl, splinepy, splipy, G+Smo and Open CASCADE, on the same arrays",
    "scaling": "time of a pass and error by the number of points and of control points",
    "compile": "first and later calls, each in a process of its own",
    "gradients": "time of a gradient beside the fit, and beside central differences",
    "batch": "many fits: a loop, `jax.lax.map`, and `map_fits` with threads and processes",
}
STUDIES = {
    "bases": "base surfaces of scans",
    "devices": "a cloud divided among devices, and among processes",
    "closest_point": "closest points: time a point, and how many are wrong",
    "growing_net": "the net chosen for a tolerance, and noise",
    "large_clouds": "clouds in memory: an iteration, what is outside the loop, memory",
    "streams": "clouds in files, larger than memory",
    "orthogonal": "orthogonal distance: passes, errors, outliers",
    "pictures": "base, default and paper side by side",
    "scans": "raw scans: what is left out, loops, areas, errors, points held out",
    "smoothing": "automatic choices of lambda",
}


def listing():
    """Names and what they measure."""
    lines = ["suites:", *(f"  {name:<14}{what}" for name, what in SUITES.items())]
    lines += ["studies:", *(f"  {name:<14}{what}" for name, what in STUDIES.items())]
    return "\n".join(lines)


def parsed(arguments):
    """The options."""
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "python -m benchmarks", description=__doc__, epilog=listing(), formatter_class=style
    )
    parser.add_argument("suites", nargs="*", metavar="suite", help=", ".join(SUITES))
    parser.add_argument("--only", nargs="+", help="parts of a suite, for instance table5")
    parser.add_argument("--runs", type=int, default=5, help="timed calls of each kind, after the first")
    parser.add_argument("--quick", action="store_true", help="the smallest inputs only")
    parser.add_argument(
        "--stand-ins", action="store_true", help="made inputs, also where there are real ones"
    )
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the figures")
    parser.add_argument("--json", type=Path, help="file for all tables")
    parser.add_argument("--markdown", type=Path, help="file for all tables")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.suites if name not in SUITES]
    if unknown:
        parser.error(f"{unknown[0]!r} is no suite; there are {', '.join(SUITES)}")
    return options


def chosen_parts(options):
    """The functions to run."""
    modules = [importlib.import_module(f"benchmarks.{name}") for name in options.suites]
    parts = [pair for module in modules for pair in module.PARTS.items()]
    names = [name for name, _ in parts]
    unknown = set(options.only or ()) - set(names)
    if unknown:
        sys.exit(f"--only {min(unknown)}: there is no such part; there are {', '.join(names)}")
    return [part for name, part in parts if not options.only or name in options.only]


def main(arguments=None):
    """Run suites, or hand over to a study."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments and arguments[0] in STUDIES:
        sys.argv = [f"benchmarks/{arguments[0]}.py", *arguments[1:]]
        importlib.import_module(f"benchmarks.{arguments[0]}").main()
        return
    options = parsed(arguments)
    if not options.suites:
        print(listing())
        return
    parts = chosen_parts(options)
    from benchmarks._report import Report

    report = Report()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    try:
        for part in parts:
            part(report, options)
    finally:
        report.write(options.json, options.markdown)


if __name__ == "__main__":
    main()
