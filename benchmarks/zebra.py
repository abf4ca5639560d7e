"""A cloud of very uneven density by three methods: Figure 10 of the paper, in numbers and as a picture.

    python benchmarks/zebra.py [--name mannequin_head] [--target 8e-4] [--picture zebra.png] [--data FOLDER]

All methods start from one dynamic base surface on one net and stop at the same average error, so that the
zebra stripes and the energies show what each does to the rest of the surface. The curvature energy (9) is
that of the surface, the thin-plate energy (10) that of its parametrisation, over the squared diagonal, and
`folds` are those of `jaxfit.regularity`.
"""

import argparse
import sys
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import helpers
import numpy as np

import jaxfit as jf
from jaxfit.plot import zebra_stripes

METHODS = {
    "base surface": None,
    "geometric, as printed": jf.GeometricApproximation.paper(insertion=None),
    "geometric, accelerated": jf.GeometricApproximation(),
    "standard": jf.StandardApproximation(smoothing=2e-5),
    "orthogonal distance": jf.OrthogonalDistance(smoothing=2e-5),
}


def main():
    parser = argparse.ArgumentParser(description="zebra stripes of three methods")
    parser.add_argument("--name", default="mannequin_head")
    parser.add_argument("--net", type=int, nargs=2, default=(42, 42))
    parser.add_argument("--target", type=float, default=8e-4)
    parser.add_argument("--picture", type=Path, default=Path("zebra.png"))
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    options = parser.parse_args()
    with np.load(options.data / f"{options.name}.npz") as arrays:
        points = arrays["points"]
        boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1")))
    base = jf.base_surface(boundary, points, tuple(options.net), method=jf.DynamicBaseSurface())
    heads = ("method", "steps", "average %", "maximum %", "energy (9)", "(10)", "folds")
    print("{:<24}{:>6}{:>11}{:>11}{:>12}{:>10}{:>7}".format(*heads))
    surfaces = []
    for title, method in METHODS.items():
        most = 200 if method else 0
        fit = jf.approximate(points, base, method, tol_average=options.target, max_steps=most)
        found = fit.regularity
        plate = found.thin_plate_energy / float(fit.stats["diagonal"]) ** 2
        print(
            f"{title:<24}{int(fit.stats['num_steps']):>6}{100 * float(fit.average_error):>11.4f}"
            f"{100 * float(fit.maximum_error):>11.4f}{found.curvature_energy:>12.4g}"
            f"{plate:>10.4g}{found.folds:>7}",
            flush=True,
        )
        surfaces.append(fit.surface)
    zebra_stripes(
        surfaces, options.picture, list(METHODS), title="{}, {} x {}".format(options.name, *base.shape)
    )
    print(f"zebra stripes: {options.picture}")


if __name__ == "__main__":
    main()
