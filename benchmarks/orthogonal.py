"""Orthogonal distance beside the paper's two methods: passes, errors, ground truth and outliers.

    python -m benchmarks orthogonal [--data FOLDER] [--part same limit truth robust]

`--data` is the folder of the data sets that the tests use. Errors are in per cent of the diagonal.

same     same net and base: 10 passes beside 200 iterations of either method of the paper
limit    the same, everything run until little moves: where the net and lambda set the limit, not the method
truth    a B-spline surface from its points and knots, from a base 5 % off
robust   1 % gross outliers and 0.02 % noise: errors against the clean points
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxfit as jf
from benchmarks._inputs import FOLDER

LAMBDAS = {"igea_face": 1e-6, "mountain": 5e-6, "mannequin_head": 5e-6}
# Orthogonal distance bends less at the same lambda, so it may have a smaller one for the same energy; more
# damping makes its first steps shorter and steadier.
OTHERWISE = {"igea_face": {"smoothing": 9e-7}, "mountain": {"smoothing": 4e-6}}
LIMITED = ("igea_face", "mountain")


def model(options, name):
    """Points, base surface, and None: no feet are known."""
    points, boundary = cloud(options, name)
    return points, jf.base_surface(boundary, points, net=(42, 42), method=jf.Meshless()), None


def cloud(options, name):
    with np.load(options.data / f"{name}.npz") as arrays:
        sides = (arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1"))
        return arrays["points"], jf.Boundary(*sides)


def row(*cells):
    """Print cells in columns: a pair is a cell and its width."""
    print("".join(f"{text!s:<{width}}" for text, width in cells), flush=True)


def columns(fit):
    """Errors of a fit, in per cent."""
    return (f"{100 * float(x):.4f}" for x in (fit.average_error, fit.maximum_error))


def same(options):
    heads()
    for name, smoothing in LAMBDAS.items():
        runs = [
            (paper(), 200),
            (jf.StandardApproximation(smoothing, **ON), 200),
            (jf.GeometricApproximation(**ON), 200),
            (jf.OrthogonalDistance(smoothing, **ON), 10),
        ]
        if name in OTHERWISE:
            settings = {"smoothing": smoothing} | OTHERWISE[name]
            runs.append((jf.OrthogonalDistance(**settings, **ON), 10))
        compared(options, name, runs)


def limit(options):
    heads()
    for name in LIMITED:
        smoothing = LAMBDAS[name]
        runs = [(paper(), 200), (jf.StandardApproximation(smoothing, **ON), 200)]
        runs += [(jf.StandardApproximation(smoothing, **ON), steps) for steps in (1000, 3000)]
        runs += [(jf.OrthogonalDistance(smoothing, **ON), steps) for steps in (10, 100, 300)]
        runs += [(paper(), 10000), (jf.GeometricApproximation(**ON), 5000)]
        compared(options, name, runs)


ON = {"stall_gain": 0.0, "stall_window": 100000}  # to the last iteration
WIDTHS = (16, 24, 8, 7, 10, 10, 12, 12, 8)


def paper():
    return jf.GeometricApproximation.paper(insertion=None, fairing=None, **ON)


def heads():
    titles = ("cloud", "method", "lambda", "steps", "avg %", "max %", "energy (9)", "(10)", "ratio")
    row(*zip(titles, WIDTHS, strict=True))


def compared(options, name, runs):
    """A line for each of `runs`; the first two are those of the paper."""
    points, base, start = model(options, name)
    errors = []
    for method, steps in runs:
        fit = jf.approximate(points, base, method, tol_average=1e-12, max_steps=steps, start=start)
        errors.append(float(fit.average_error))
        energy = float(jf.curvature_energy(fit.surface))
        bending = float(fit.stats.get("bending_energy", np.nan)) / float(fit.stats["diagonal"]) ** 2
        plate = getattr(method, "smoothing", "")
        cells = (name, type(method).__name__, plate, steps, *columns(fit), f"{energy:.4g}")
        ratio = f"{errors[-1] / min(errors[:2]):.3f}"  # to the better method of the paper
        row(*zip((*cells, f"{bending:.4g}", ratio), WIDTHS, strict=True))


def truth(options):
    with np.load(options.data / "bspline_reference.npz") as arrays:
        points, net, grid = (arrays[x] for x in ("points", "control_points", "grid40"))
        knots = [arrays[x] / arrays[x][-1] for x in ("knots_u", "knots_v")]
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    inner = net[1:-1, 1:-1]
    net[1:-1, 1:-1] += 0.05 * diagonal * np.random.default_rng(0).uniform(-1, 1, inner.shape)
    base = jf.BSplineSurface(net, *knots)
    for kind in (jf.OrthogonalDistance, jf.StandardApproximation):
        method = kind(smoothing=0.0, stall_gain=0.0)
        fit = jf.approximate(points, base, method, tol_average=1e-13, max_steps=40)
        away = float(jnp.max(jf.closest_point(fit.surface, grid.reshape(-1, 3)).distance)) / diagonal
        steps = int(fit.stats["num_steps"])
        print(f"bspline_reference, {kind.__name__}, {steps} steps: {away:.1e} from the true surface")
        errors = np.asarray(fit.history.average)[:16]
        print("  average after each:", " ".join(f"{x:.0e}" for x in errors), flush=True)


def robust(options):
    widths = (12, 24, 24, 10, 8)
    row(*zip(("cloud", "method", "loss", "avg %", "ratio"), widths, strict=True))
    for name in ("igea_face", "mountain"):
        clean, base, _ = model(options, name)
        diagonal = np.linalg.norm(np.ptp(clean, axis=0))
        rng = np.random.default_rng(0)
        noisy = clean + 2e-4 * diagonal * rng.normal(size=clean.shape) / np.sqrt(3)
        wild = rng.choice(len(clean), len(clean) // 100, replace=False)
        noisy[wild] = clean[wild] + 0.1 * diagonal * rng.normal(size=(wild.size, 3))
        runs = [("none, clean points", clean, None), ("none", noisy, None)]
        runs += [(type(x).__name__, noisy, x) for x in (jf.Huber(), jf.Tukey(), jf.GemanMcClure())]
        for kind in (jf.OrthogonalDistance, jf.StandardApproximation, jf.GeometricApproximation):
            plate = {} if kind is jf.GeometricApproximation else {"smoothing": 2e-5}
            reference = None
            for title, points, loss in runs:
                method = kind(loss=loss, **plate)
                fit = jf.approximate(points, base, method, tol_average=1e-9, max_steps=20 if plate else 100)
                distance = jf.closest_point(fit.surface, clean).distance
                average = 100 * float(jnp.mean(distance)) / diagonal
                reference = average if reference is None else reference
                cells = (name, kind.__name__, title, f"{average:.4f}", f"{average / reference:.2f}")
                row(*zip(cells, widths, strict=True))


PARTS = {"same": same, "limit": limit, "truth": truth, "robust": robust}


def main():
    parser = argparse.ArgumentParser(description="orthogonal distance beside the paper's methods")
    parser.add_argument("--data", type=Path, default=FOLDER)
    parser.add_argument("--part", nargs="*", choices=PARTS, default=list(PARTS))
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64")
    for part in options.part:
        PARTS[part](options)


if __name__ == "__main__":
    main()
