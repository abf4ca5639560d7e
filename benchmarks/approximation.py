"""Tables 4 and 5 of the paper: base surfaces, and approximation by the geometric and the standard method.

    python benchmarks/approximation.py --work FOLDER [--program ./oracle] [--data FOLDER] [--runs 3]

`--work` holds stand-ins for the paper's models, each a surface NAME_U.npy, NAME_V.npy, NAME_P.npy, points
NAME_pts.npy and feet NAME_uv0.npy; `--program` runs the same methods (commands `gapprox` and `sapprox`) and
prints a line of JSON. Errors are in % of the diagonal, times in s, the first call, which compiles, apart.
All run on one thread, like the program, unless NPROC says otherwise.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("NPROC", "1")  # read by JAX as it starts

import jax
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers

import jaxfit as jf

# name: target average, smoothing, fairing in the geometric method, and the paper's two rows of Table 5
MODELS = {
    "gc": (6e-4, 1e-4, False, "11x15 141 0.5239 1.70 | 14x18 81 0.8352 1.67"),
    "mq": (6e-4, 2e-5, True, "42x42 135 0.7750 6.23 | 42x42 31 1.0520 8.21"),
    "cm": (2e-4, 2e-5, True, "62x57 54 0.3752 23.89 | 62x57 20 0.3254 29.93"),
}
# name: net, base surface, target average, smoothing
CLOUDS = {
    "blade_wrap_3000": ((24, 40), jf.Coons(), 6e-4, 2e-5),
    "igea_face": ((42, 42), jf.Meshless(), 3e-4, 2e-5),
    "mannequin_head": ((42, 42), jf.Meshless(), 8e-4, 2e-5),
    "mountain": ((42, 42), jf.Meshless(), 3e-4, 2e-5),
    "jacksboro_dem": ((62, 57), jf.Coons(), 6e-4, 2e-5),
}


def model(work, name):
    net, u, v = (np.load(work / f"{name}_{part}.npy") for part in "PUV")
    points, feet = np.load(work / f"{name}_pts.npy"), np.load(work / f"{name}_uv0.npy")
    return points, jf.BSplineSurface(net, u, v), (feet[:, 0], feet[:, 1])


def cloud(name):
    arrays = helpers.data(name)
    if "grid" in arrays:
        sides = helpers.grid_edges(arrays["grid"])
        return arrays["grid"].reshape(-1, 3), jf.Boundary(**sides)
    return arrays["points"], jf.Boundary(
        **{k[-2:]: x for k, x in arrays.items() if k.startswith("boundary_")}
    )


def methods(fairing, smoothing):
    paper = {} if fairing else {"fairing": None}
    return {
        "geometric, paper's": jf.GeometricApproximation.paper(**paper),
        "geometric, default": jf.GeometricApproximation(insertion=jf.KnotInsertion()),
        "standard": jf.StandardApproximation(smoothing=smoothing, insertion=jf.KnotInsertion(every=10)),
    }


def theirs(program, work, name, method, out):
    target, smoothing, fairing, _ = MODELS[name]
    arguments = {"surf": work / name, "pts": f"{work / name}_pts.npy", "uv": f"{work / name}_uv0.npy"}
    arguments |= {"eavg": target, "out": out}
    if method == "standard":
        command, more = "sapprox", {"lambda": smoothing, "ins": 10, "solver": "csparse"}
    else:
        command, more = "gapprox", {"ins": 40, "fair": 20 if fairing else 0, "gamma": 2}
        if method.endswith("default"):
            more |= {"fair": 0, "relax": 1.7, "tight": 1, "predict": 1}
    line = [program, command, *(f"{key}={value}" for key, value in (arguments | more).items())]
    printed = subprocess.run(line, check=True, capture_output=True, text=True).stdout
    return json.loads(printed.strip().splitlines()[-1])


def rows(name, points, base, start, target, choices, runs, program=None):
    for title, method in choices.items():

        def fit(method=method):
            begun = time.perf_counter()
            found = jf.approximate(points, base, method, tol_average=target, max_steps=200, start=start)
            jax.block_until_ready(found.errors)
            return found, time.perf_counter() - begun

        found, first = fit()
        seconds = [fit()[1] for _ in range(runs)]
        net = "{}x{}".format(*found.surface.shape)
        print(
            f"{name:<16}{title:<20}{net:>7}{int(found.stats['num_steps']):>6}"
            f"{100 * float(found.maximum_error):>9.4f}{100 * float(found.average_error):>9.4f}"
            f"{first:>8.2f}{np.median(seconds):>8.3f} [{min(seconds):.3f}, {max(seconds):.3f}]"
            + ("" if program is None else program(title))
            + ("" if bool(found.converged) else f"  {found.message[:40]}..."),
            flush=True,
        )


def main():
    parser = argparse.ArgumentParser(description="Tables 4 and 5: approximation of scattered points")
    parser.add_argument("--work", type=Path, help="folder of the stand-ins")
    parser.add_argument("--program", help="another implementation, run beside on the stand-ins")
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--clouds", nargs="*", default=list(CLOUDS))
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    print("Table 4: base surfaces\n{:<36}{:>9}{:>9}{:>9}".format("", "net", "max %", "avg %"))
    ready = []
    for name in options.models if options.work else []:
        points, base, start = model(options.work, name)
        target, smoothing, fairing, paper = MODELS[name]
        ready.append((name, points, base, start, target, methods(fairing, smoothing), paper))
    for name in options.clouds:
        net, how, target, smoothing = CLOUDS[name]
        points, boundary = cloud(name)
        base = jf.base_surface(boundary, points, net=net, method=how)
        ready.append((name, points, base, None, target, methods(True, smoothing), None))
    for name, points, base, *_ in ready:
        errors = 100 * np.asarray(jf.closest_point(base, points).distance) / helpers.diagonal(points)
        net = "{} x {}".format(*base.shape)
        print(f"{name:<36}{net:>9}{errors.max():>9.4f}{errors.mean():>9.4f}")
    heads = ("max %", "avg %", "first", "s")
    print("\nTable 5\n{:<36}{:>7}{:>6}{:>9}{:>9}{:>8}{:>8}".format("", "net", "steps", *heads))
    with tempfile.TemporaryDirectory() as folder:
        for name, points, base, start, target, choices, paper in ready:
            beside = None
            if paper is not None and options.program:

                def beside(title, name=name):
                    report = theirs(options.program, options.work, name, title, f"{folder}/out")
                    return f"  program: {report['n']}x{report['m']} {report['iters']} {report['cpu']:.3f} s"

            rows(name, points, base, start, target, choices, options.runs, beside)
            if paper is not None:
                print(f"{'':<16}paper (net steps max s), geometric | standard: {paper}")


if __name__ == "__main__":
    main()
