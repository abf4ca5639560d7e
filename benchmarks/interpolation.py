"""Interpolation of grids: Tables 1 to 3 of the paper, and what goes past them.

    python benchmarks/interpolation.py [--runs 5] [--data FOLDER] [--program ORACLE --work FOLDER]

One row for each grid and method: iterations, maximum and average error in per cent of the diagonal,
evaluations of the surface per point, the median time of a fit with the spread (lowest to highest), and the
first call, which compiles unless a grid of that size came before. Under each grid what holding the feet
(Table 1) and optimal repositioning (Table 2) change, beside what the paper reports for a model of that size.
With the program of an independent implementation and its work folder, the same runs there follow each row.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers

import jaxfit as jf

GRIDS = (
    "hood_beetle_10x10",
    "fran_face_45x49",
    "fuselage_d150_50x200",
    "fuselage_d150_100x400",
    "jacksboro_dem",
)
STAND_INS = ("hood", "fus10k", "fus40k")
UNIT = jf.UnitWeights()
METHODS = {
    "standard": (jf.StandardInterpolation(), "sinterp solver=tensor"),
    "plain": (jf.GeometricInterpolation(repositioning=UNIT, freeze_after=None), "ginterp weight=none fix=0"),
    "frozen feet": (jf.GeometricInterpolation(repositioning=UNIT), "ginterp weight=none fix=2"),
    "weights (27)": (jf.GeometricInterpolation(freeze_after=None), "ginterp weight=opt fix=0"),
    "constant (17)": (
        jf.GeometricInterpolation(repositioning=jf.ConstantWeight(), freeze_after=None),
        "ginterp weight=lu fix=0",
    ),
    "frozen + (27)": (jf.GeometricInterpolation(), "ginterp weight=opt fix=2"),
    "Chebyshev": (jf.GeometricInterpolation(repositioning=UNIT, acceleration=jf.Chebyshev()), None),
}
COUNTED = ("iterations", "evaluations", "time")
# Final errors of the paper's tables on grids of these sizes, so that the iterations can be compared.
TOLERANCE = {"hood": 4e-14, "fus10k": 2e-15, "fus40k": 2e-15}
LEAST_TOLERANCE = 1e-14
# Of the paper's models by size: seconds without and with, in Tables 1 and 2; iterations in Table 3.
PAPER = {
    (10, 10): ((0.0748, 0.0340), (0.0748, 0.0492), 134),
    (50, 200): ((5.6752, 1.1846), (5.6752, 4.8750), 108),
    (100, 400): (None, None, 103),
}


def row(grid, name, method, tolerance, runs):
    """Fit `runs` times after the first, and print; returns (iterations, evaluations, seconds)."""
    times = []
    for _ in range(runs + 1):
        begin = time.perf_counter()
        fit = jf.interpolate(grid, method, tolerance=tolerance, max_steps=600)
        jax.block_until_ready(fit.surface)
        times.append(time.perf_counter() - begin)
    first, *times = times
    evaluations = float(np.nansum(np.asarray(fit.history.evaluations)))
    print(
        f"  {name:<15}{int(fit.stats['num_steps']):>5}  {100 * float(fit.maximum_error):9.2e}"
        f"  {100 * float(fit.average_error):9.2e}  {evaluations:7.1f}  {np.median(times):8.4f} s"
        f" [{min(times):.4f}, {max(times):.4f}]  first {first:5.2f} s  "
        f"{'' if bool(fit.converged) else fit.message}",
        flush=True,
    )
    return int(fit.stats["num_steps"]), evaluations, float(np.median(times))


def program_row(options, name, arguments, tolerance):
    """The same runs in the other program, which prints one line of JSON each time."""
    with tempfile.TemporaryDirectory() as folder:
        command = [options.program, *arguments.split(), f"grid={options.work / name}.npy", f"out={folder}/k"]
        command += [f"tol={tolerance}", "cptol=1e-13"]
        runs = [
            subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(options.runs)
        ]
    found, *others = (json.loads(run.stdout.splitlines()[-1]) for run in runs)
    times = [x["cpu"] for x in (found, *others)]
    steps, largest, average = found.get("iters", 0), 100 * found["max"], 100 * found["avg"]
    print(
        f"    other program {steps:>3}  {largest:9.2e}  {average:9.2e}  {'':7}  {np.median(times):8.4f} s",
        end="",
    )
    print(f" [{min(times):.4f}, {max(times):.4f}]")


def change(before, after, paper):
    """What an acceleration changes, in words."""
    parts = [f"{name} {x:.4g} -> {y:.4g}" for name, x, y in zip(COUNTED, before, after, strict=True)]
    beside = f", paper {100 * (paper[1] / paper[0] - 1):.0f} %" if paper else ""
    return f"{', '.join(parts)} s ({100 * (after[2] / before[2] - 1):.0f} %{beside})"


def table(name, grid, tolerance, options, stand_in):
    """All methods on one grid."""
    print(f"{name}: {grid.shape[0]} x {grid.shape[1]} points, tolerance {100 * tolerance:g} %")
    done = {}
    for label, (method, arguments) in METHODS.items():
        if options.methods and label not in options.methods:
            continue
        done[label] = row(grid, label, method, tolerance, options.runs)
        if stand_in and options.program and arguments:
            program_row(options, name, arguments, tolerance)
    if tolerance > LEAST_TOLERANCE and "frozen + (27)" in done:
        row(grid, "... to rounding", METHODS["frozen + (27)"][0], LEAST_TOLERANCE, options.runs)
    fixing, weighting, steps = PAPER.get(grid.shape[:2], (None, None, None))
    if {"plain", "frozen feet"} <= set(done):
        print("  Table 1, holding the feet:", change(done["plain"], done["frozen feet"], fixing))
    if {"plain", "weights (27)"} <= set(done):
        print("  Table 2, repositioning:", change(done["plain"], done["weights (27)"], weighting))
    if "frozen + (27)" in done and steps:
        print(f"  Table 3, both: {done['frozen + (27)'][0]} iterations (paper: {steps} on its own model)")


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5, help="timed fits of each kind, after one")
    parser.add_argument("--data", type=Path, default=helpers.FOLDER, help="folder of the .npz files")
    parser.add_argument("--program", type=Path, help="an independent implementation to run beside")
    parser.add_argument("--work", type=Path, help="its folder of grids (.npy)")
    parser.add_argument("--grids", nargs="*", help="only these")
    parser.add_argument("--methods", nargs="*", help="only these")
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.default_backend()}, {os.cpu_count()} cores, float64")
    print("  method         steps  max err %  avg err %  evaluations  median time [lowest, highest]")
    for name in STAND_INS if options.work else ():
        if not options.grids or name in options.grids:
            table(name, np.load(options.work / f"{name}.npy"), TOLERANCE[name], options, True)
    for name in GRIDS:
        path = options.data / f"{name}.npz"
        if options.grids and name not in options.grids:
            continue
        if not path.is_file():
            print(f"{name}: not in {options.data}, left out")
            continue
        table(name, np.load(path)["grid"], LEAST_TOLERANCE, options, False)


if __name__ == "__main__":
    main()
