"""Orthogonal distance beside the paper's two methods: passes, errors, time, ground truth and outliers.

    python benchmarks/orthogonal.py --work FOLDER --program ./oracle --data FOLDER [--part speed same ...]

`--program` is a command-line program `gapprox surf= pts= uv= eavg= ins= fair= gamma=`, the geometric method.
It reads models NAME_P.npy, NAME_U.npy, NAME_V.npy (control points and knots), NAME_pts.npy and NAME_uv0.npy
(points and feet) from `--work` and prints a line of JSON with its time `cpu`, errors `avg` and `max`, net
`n`, `m` and iterations `iters`; for `far` also the sides NAME_b0, b1, a0, a1 (v and u at 0 and 1). `--data`
is the folder of the data sets that the tests use. Errors are in per cent of the diagonal, times medians after
the first call; ours and theirs take turns.

speed    to the target average from the same base: passes over the points and time
same     same net and base: 10 passes beside 200 iterations of either method of the paper
limit    the same, everything run until little moves: where the net and lambda set the limit, not the method
truth    a B-spline surface from its points and knots, from a base 5 % off
robust   1 % gross outliers and 0.02 % noise: errors against the clean points
far      bases far from the points, where feet say little: errors and folds, from the base, from the same with
         every span halved, and from bases made with the points
"""

import argparse
import functools
import itertools
import json
import subprocess
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxfit as jf

TARGETS = {"mq": 6e-4, "cm": 2e-4}
LAMBDAS = {"mq": 5e-6, "igea_face": 1e-6, "mountain": 5e-6, "mannequin_head": 5e-6}
# Orthogonal distance bends less at the same lambda, so it may have a smaller one for the same energy; more
# damping makes its first steps shorter and steadier.
OTHERWISE = {"mq": {"damping": 0.1}, "igea_face": {"smoothing": 9e-7}, "mountain": {"smoothing": 4e-6}}
LIMITED = ("igea_face", "mountain")


def model(options, name):
    """Points, base surface, and feet on it if they are known."""
    if (options.work / f"{name}_P.npy").is_file():
        net, u, v, points, feet = (
            np.load(options.work / f"{name}_{x}.npy") for x in ("P", "U", "V", "pts", "uv0")
        )
        return points, jf.BSplineSurface(net, u, v), (feet[:, 0], feet[:, 1])
    points, boundary = cloud(options, name)
    return points, jf.base_surface(boundary, points, net=(42, 42), method=jf.Meshless()), None


def cloud(options, name):
    with np.load(options.data / f"{name}.npz") as arrays:
        sides = (arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1"))
        return arrays["points"], jf.Boundary(*sides)


def timed(work):
    begun = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begun


def row(*cells):
    """Print cells in columns: a pair is a cell and its width."""
    print("".join(f"{text!s:<{width}}" for text, width in cells), flush=True)


def columns(fit):
    """Errors of a fit, in per cent."""
    return (f"{100 * float(x):.4f}" for x in (fit.average_error, fit.maximum_error))


def speed(options):
    widths = (7, 20, 8, 10, 10, 8, 10, 8)
    heads = ("model", "method", "passes", "avg %", "max %", "net", "seconds", "theirs/ours")
    row(*zip(heads, widths, strict=True))
    for name, target in TARGETS.items():
        points, base, start = model(options, name)

        def ours(points=points, base=base, start=start, target=target):
            method = jf.OrthogonalDistance()
            return jf.approximate(points, base, method, tol_average=target, max_steps=20, start=start)

        ours()
        spent, other = [], []
        for _ in range(options.turns):
            fit, seconds = timed(ours)
            spent.append(seconds)
            report = theirs(options, name, target)
            other.append(report["cpu"])
        net = "x".join(str(x) for x in fit.surface.shape)
        passes = len(fit.history.average)  # every surface that was measured, the base included
        seconds = (np.median(spent), np.median(other))
        cells = (name, "OrthogonalDistance", passes, *columns(fit), net, f"{seconds[0]:.3f}")
        row(*zip((*cells, f"{seconds[1] / seconds[0]:.2f}"), widths, strict=True))
        net, errors = f"{report['n']}x{report['m']}", (f"{100 * report[x]:.4f}" for x in ("avg", "max"))
        cells = (name, "program", report["iters"] + 1, *errors, net, f"{seconds[1]:.3f}", "")
        row(*zip(cells, widths, strict=True))


def theirs(options, name, target):
    files = {"surf": name, "pts": f"{name}_pts.npy", "uv": f"{name}_uv0.npy"}
    settings = {"eavg": target, "ins": 40, "fair": 20, "gamma": 2}
    words = [f"{key}={options.work / value}" for key, value in files.items()]
    words += [f"{key}={value}" for key, value in settings.items()]
    printed = subprocess.run([options.program, "gapprox", *words], check=True, capture_output=True, text=True)
    return json.loads(printed.stdout.strip().splitlines()[-1])


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


def far(options):
    widths = (6, 10, 7, 24, 7, 10, 10, 22, 8)
    heads = ("model", "base", "net", "method", "steps", "avg %", "max %", "folded % (base's)", "result")
    row(*zip(heads, widths, strict=True))
    kinds = (jf.GeometricApproximation, jf.StandardApproximation, jf.OrthogonalDistance)
    for name in ("gc", "gh"):
        for (title, points, base, start), kind in itertools.product(bases(options, name), kinds):
            fit = jf.approximate(points, base, kind(), tol_average=6e-4, max_steps=300, start=start)
            folds = f"{100 * folded(fit.surface):.3f} ({100 * folded(base):.3f})"
            net = "x".join(str(x) for x in fit.surface.shape)
            cells = (title, net, kind.__name__, int(fit.stats["num_steps"]), *columns(fit), folds)
            row(*zip((name, *cells, fit.message[:30]), widths, strict=True))


def bases(options, name):
    """The far base, the same with spans halved, and two made with the points on as many control points."""
    points, base, start = model(options, name)
    boundary = jf.Boundary(*(np.load(options.work / f"{name}_{x}.npy") for x in ("b0", "b1", "a0", "a1")))
    breaks = (np.unique(k) for k in (base.knots_u, base.knots_v))
    middles = ((x[1:] + x[:-1]) / 2 for x in breaks)
    on_points = functools.partial(jf.base_surface, boundary, points, base.shape)
    return [
        ("far", points, base, start),
        ("halved", points, base.insert_knots(*middles), start),
        ("dynamic", points, on_points(method=jf.DynamicBaseSurface()), None),
        ("meshless", points, on_points(method=jf.Meshless()), None),
    ]


def folded(surface):
    """Share of neighbours on a fine grid whose normals are more than a right angle apart."""
    u, v = (np.linspace(k[0], k[-1], 401) for k in (surface.knots_u, surface.knots_v))
    n = np.asarray(surface.normal(*np.meshgrid(u, v, indexing="ij")))
    cosines = [np.sum(n[1:] * n[:-1], -1), np.sum(n[:, 1:] * n[:, :-1], -1)]
    return float(np.mean(np.concatenate([x.ravel() for x in cosines]) < 0))


PARTS = {"speed": speed, "same": same, "limit": limit, "truth": truth, "robust": robust, "far": far}


def main():
    parser = argparse.ArgumentParser(description="orthogonal distance beside the paper's methods")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--program", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--part", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--turns", type=int, default=5)
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.default_backend()}, float64")
    for part in options.part:
        PARTS[part](options)


if __name__ == "__main__":
    main()
