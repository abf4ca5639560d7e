"""Automatic lambda beside the best one: standard fits of noisy clouds, judged by the points without noise.

    python -m benchmarks smoothing [--data FOLDER] [--noise 3e-3] [name ...]

Noise is normal, its length a fraction of the diagonal on average. For every lambda: the mean distance of the
points without noise from the surface fitted to those with, in % of the diagonal. Then what
`GeneralizedCrossValidation` and `Discrepancy` (which is told the noise) choose, and how far that is from the
best lambda of the table, as a factor.
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

NAMES = ("igea_face", "mountain", "mannequin_head")
LAMBDAS = 10.0 ** np.arange(-8, 0.5, 0.5)
STEPS = 10


def error(points, clean, base, smoothing):
    """Mean distance of the clean points, as a fraction of the diagonal, and the lambda used."""
    method = jf.StandardApproximation(smoothing)
    fit = jf.approximate(points, base, method, tol_average=0.0, max_steps=STEPS)
    away = np.asarray(jf.closest_point(fit.surface, clean).distance)
    return float(away.mean()) / helpers.diagonal(clean), float(fit.stats["smoothing"])


def main():
    parser = argparse.ArgumentParser(description="automatic choices of lambda")
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    parser.add_argument("--noise", type=float, default=3e-3)
    options = parser.parse_args()
    for name in options.names:
        with np.load(options.data / f"{name}.npz") as arrays:
            clean = arrays["points"]
            boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
        sigma = options.noise * helpers.diagonal(clean) / np.sqrt(3)
        noisy = clean + sigma * np.random.default_rng(0).normal(size=clean.shape)
        base = jf.base_surface(boundary, noisy, (42, 42), method=jf.Meshless())
        table = [error(noisy, clean, base, x)[0] for x in LAMBDAS]
        best = LAMBDAS[int(np.argmin(table))]
        print(f"{name}, {len(clean)} points, 42x42, noise {100 * options.noise:g} %")
        print("  " + "  ".join(f"{x:.0e} {100 * e:.4f}" for x, e in zip(LAMBDAS, table, strict=True)))
        print(f"  {'best':<28}{best:>10.1e}{100 * min(table):>10.4f} %")
        for choice in (jf.GeneralizedCrossValidation(), jf.Discrepancy(options.noise / np.sqrt(3))):
            away, chosen = error(noisy, clean, base, choice)
            factor = max(chosen / best, best / chosen)
            title = type(choice).__name__
            print(f"  {title:<28}{chosen:>10.1e}{100 * away:>10.4f} %{factor:>8.1f} times", flush=True)


if __name__ == "__main__":
    main()
