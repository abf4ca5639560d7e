"""Figure 4b of the paper: average error per iteration with and without fairing, and the shapes.

    python benchmarks/fairing.py [--work FOLDER] [--picture fairing.png] [--steps 160]

On the stand-in `mq` in `--work` (files as for `approximation.py`), else on the scan `mannequin_head`. Prints
the errors around every fairing step, and the variation of the mean curvature H over the surface: the integral
of |H_u| + |H_v| along the parameter lines of a fine grid, times the diagonal.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / x) for x in ("", "tests")]
jax.config.update("jax_enable_x64", True)

import helpers

import jaxfit as jf


def problem(work):
    if work is not None:
        net, u, v = (np.load(work / f"mq_{part}.npy") for part in "PUV")
        return "mq", np.load(work / "mq_pts.npy"), jf.BSplineSurface(net, u, v)
    arrays = helpers.data("mannequin_head")
    sides = {key[-2:]: line for key, line in arrays.items() if key.startswith("boundary_")}
    points = arrays["points"]
    base = jf.base_surface(jf.Boundary(**sides), points, net=(39, 39), method=jf.Meshless())
    return "mannequin_head", points, base


def variation(surface, diagonal, count=300):
    at = (np.arange(count) + 0.5) / count
    mean = diagonal * np.asarray(surface.curvature(*np.meshgrid(at, at, indexing="ij")).mean)
    return sum(np.abs(np.diff(mean, axis=axis)).sum() / count for axis in (0, 1))


def draw(path, name, histories):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    for label, average in histories.items():
        axes.semilogy(100 * average, label=label)
    axes.set_xlabel("iteration")
    axes.set_ylabel("average error, % of the diagonal")
    axes.set_title(f"{name}: fairing every 20 iterations, new knots every 40")
    axes.legend()
    figure.savefig(path, dpi=130)


def main():
    parser = argparse.ArgumentParser(description="Figure 4b: errors with and without fairing")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--picture", default="fairing.png")
    parser.add_argument("--steps", type=int, default=160)
    options = parser.parse_args()
    name, points, base = problem(options.work)
    histories = {}
    for label, fairing in (("with fairing", jf.Fairing()), ("without", None)):
        method = jf.GeometricApproximation.paper(fairing=fairing)
        fit = jf.approximate(points, base, method, tol_average=0.0, max_steps=options.steps)
        histories[label] = np.asarray(fit.history.average)
        bends = variation(fit.surface, helpers.diagonal(points))
        net = "{}x{}".format(*fit.surface.shape)
        print(f"{name}, {label}: {net}, {fit.stats['num_steps']} iterations, curvature variation {bends:.1f}")
    print("{:>10}{:>14}{:>14}".format("iteration", *histories))
    for step in range(19, options.steps, 20):
        for k in range(step, min(step + 3, options.steps + 1)):
            row = (100 * x[k] if k < x.size else np.nan for x in histories.values())
            print("{:>10}{:>14.4f}{:>14.4f}".format(k, *row))
    draw(options.picture, name, histories)
    print(f"written: {options.picture}")


if __name__ == "__main__":
    main()
