"""Base surfaces of scanned clouds: distance of the cloud from each, and of the fits that start there.

    python -m benchmarks bases [--data FOLDER] [--max-steps N] [--spoil KIND ...] [name ...]

Distances are to true closest points, in % of the diagonal of the cloud's bounding box. Fits are those of the
default method, to the average error named or for as many iterations as allowed. `folds` are those of
`jaxfit.regularity`: where the surface folds over, or turns more sharply than its samples show. With
`--spoil`, only meshless bases are made, of clouds with noise of 0.3 or 1 % of the diagonal, with holes, or
with a density that falls fifty times from one side to the other; distances are those of the whole clean
cloud.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import helpers

import jaxfit as jf

# name: net, average error of the fit
CLOUDS = {
    "mannequin_head": ((42, 42), 8e-4),
    "igea_face": ((42, 42), 3e-4),
    "blade_wrap_3000": ((24, 40), 6e-4),
    "mountain": ((42, 42), 3e-4),
}
SPOILT = ("noise0.3", "noise1", "holes", "uneven")
METHODS = {"Coons": jf.Coons(), "dynamic": jf.DynamicBaseSurface(), "meshless": jf.Meshless()}


def spoilt(points, kind):
    """The cloud with noise, with holes of an eighth of the diagonal across, or thinned towards one side."""
    rng, size = np.random.default_rng(0), helpers.diagonal(points)
    if kind.startswith("noise"):
        return points + float(kind[5:]) / 100 * size / np.sqrt(3) * rng.normal(size=points.shape)
    if kind == "holes":
        middles = points[rng.integers(len(points), size=4)]
        return points[(np.linalg.norm(points[:, None] - middles, axis=2) > size / 8).all(axis=1)]
    across = (points[:, 0] - points[:, 0].min()) / np.ptp(points[:, 0])
    return points[rng.random(len(points)) < 50.0**-across]


def spoilt_row(name, kind, points, boundary):
    net, _ = CLOUDS[name]
    given = spoilt(points, kind)
    begun = time.perf_counter()
    base = jf.base_surface(boundary, given, net, method=jf.Meshless())
    seconds = time.perf_counter() - begun
    distance = 100 / helpers.diagonal(points) * np.asarray(jf.closest_point(base, points).distance)
    print(
        f"{name:<16}{kind:<10}{'{} x {}'.format(*net):>8}{seconds:>7.1f}"
        f"{distance.mean():>10.4f}{distance.max():>9.3f}{jf.regularity(base).folds:>8}",
        flush=True,
    )


def row(name, label, points, boundary, max_steps, target):
    net, usual = CLOUDS[name]
    begun = time.perf_counter()
    base = jf.base_surface(boundary, points, net, method=METHODS[label])
    seconds = time.perf_counter() - begun
    share = 100 / helpers.diagonal(points)
    distance = share * np.asarray(jf.closest_point(base, points).distance)
    target = usual if target is None else target
    fit = jf.approximate(points, base, tol_average=target, max_steps=max_steps)
    print(
        f"{name:<16}{label:<10}{'{} x {}'.format(*net):>8}{seconds:>7.1f}"
        f"{distance.mean():>10.4f}{distance.max():>9.3f}{jf.regularity(base).folds:>8}"
        f"{int(fit.stats['num_steps']):>7}{100 * float(fit.average_error):>10.4f}"
        f"{100 * float(fit.maximum_error):>9.3f}{fit.regularity.folds:>8}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description="base surfaces of scanned clouds")
    parser.add_argument("names", nargs="*", default=list(CLOUDS))
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    parser.add_argument("--max-steps", type=int, default=200)
    parser.add_argument(
        "--target", type=float, help="average error of all fits, as a fraction of the diagonal"
    )
    parser.add_argument("--spoil", nargs="+", choices=SPOILT, default=[], help="what is done to the cloud")
    options = parser.parse_args()
    heads = (
        "data",
        "base",
        "net",
        "time/s",
        "average",
        "maximum",
        "folds",
        "steps",
        "fit ave.",
        "maximum",
        "folds",
    )
    print(("{:<16}{:<10}{:>8}{:>7}{:>10}{:>9}{:>8}{:>7}{:>10}{:>9}{:>8}").format(*heads))
    for name in options.names:
        with np.load(options.data / f"{name}.npz") as arrays:
            points = arrays["points"]
            boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
        for kind in options.spoil:
            spoilt_row(name, kind, points, boundary)
        for label in () if options.spoil else METHODS:
            row(name, label, points, boundary, options.max_steps, options.target)


if __name__ == "__main__":
    main()
