"""Plain Algorithm 1 beside another implementation of it: control points and time.

    python benchmarks/algorithm1.py --program ./oracle --work FOLDER

`--program` is a command-line program `gapprox surf= pts= uv= maxit= ... out=` that runs Algorithm 1 from a
surface NAME_U.npy, NAME_V.npy, NAME_P.npy, points NAME_pts.npy and feet NAME_uv0.npy in `--work`, writes the
control points to OUT_P.npy and prints a line of JSON with its time `cpu` and error `avg`.
"""

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxfit as jf

STEPS = (1, 5, 20)


def theirs(program, work, name, steps, out):
    arguments = {
        "surf": work / name,
        "pts": work / f"{name}_pts.npy",
        "uv": work / f"{name}_uv0.npy",
        "maxit": steps,
        "eavg": 1e-9,
        "ins": 0,
        "fair": 0,
        "cptol": 1e-12,
        "cpmaxit": 400,
        "out": out,
    }
    command = [program, "gapprox", *(f"{key}={value}" for key, value in arguments.items())]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(printed.strip().splitlines()[-1]), np.load(f"{out}_P.npy")


def ours(work, name, steps):
    net, u, v = (np.load(work / f"{name}_{part}.npy") for part in "PUV")
    points, start = np.load(work / f"{name}_pts.npy"), np.load(work / f"{name}_uv0.npy")
    base = jf.BSplineSurface(net, u, v)
    begun = time.perf_counter()
    plain = jf.GeometricApproximation(relaxation=1.0, acceleration=None, single_step=False)
    options = dict(tol_average=1e-12, max_steps=steps, start=(start[:, 0], start[:, 1]))
    options["errors"] = jf.LocalFeet()  # as the program, which searches only from the feet it has
    fit = jf.approximate(points, base, plain, **options)
    return fit, time.perf_counter() - begun, np.linalg.norm(np.ptp(points, axis=0))


def main():
    parser = argparse.ArgumentParser(description="Algorithm 1 beside another implementation")
    parser.add_argument("--program", required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--models", nargs="+", default=["gc", "mq", "cm"])
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    heads = ("model", "steps", "net differs by", "avg %", "their avg %", "first s", "s", "their cpu s")
    print("{:<7}{:>6}{:>16}{:>10}{:>13}{:>9}{:>9}{:>13}".format(*heads))
    with tempfile.TemporaryDirectory() as folder:
        for name in options.models:
            for steps in STEPS:
                report, net = theirs(options.program, options.work, name, steps, f"{folder}/out")
                fit, first, diagonal = ours(options.work, name, steps)
                seconds = [ours(options.work, name, steps)[1] for _ in range(options.runs)]
                differs = np.abs(np.asarray(fit.surface.control_points) - net).max() / diagonal
                average = 100 * float(fit.history.average[-1])
                print(
                    f"{name:<7}{steps:>6}{differs:>16.1e}{average:>10.5f}{100 * report['avg']:>13.5f}"
                    f"{first:>9.2f}{np.median(seconds):>9.3f}{report['cpu']:>13.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
