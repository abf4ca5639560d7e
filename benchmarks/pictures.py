"""Base surface, default fit and the paper's fit of each scan, side by side: shading, zebra stripes, folds.

    python -m benchmarks pictures [--target 1e-6] [--max-steps 200] [--folder .] [--data FOLDER] [name ...]

The target may be out of reach, so that one sees what a method does to a surface that cannot be as close as
asked. Folds are red in the pictures `<name>.png`. The table counts them, with the smallest angle between
parameter lines and both energies, curvature (9) and thin plate (10); the latter is over the squared diagonal.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import helpers

import jaxfit as jf
from jaxfit.plot import zebra_stripes

NETS = {
    "igea_face": (42, 42),
    "mannequin_head": (42, 42),
    "mountain": (42, 42),
    "blade_wrap_3000": (24, 40),
    "jacksboro_dem": (62, 57),
}
METHODS = {
    "base": None,
    "default": None,
    "as printed, without insertion": jf.GeometricApproximation.paper(insertion=None),
}


def read(path):
    with np.load(path) as arrays:
        if "points" not in arrays:
            grid = arrays["grid"]
            return grid.reshape(-1, 3), jf.Boundary.from_grid(grid)
        sides = (arrays[f"boundary_{side}"] for side in ("v0", "v1", "u0", "u1"))
        return arrays["points"], jf.Boundary(*sides)


def compare(name, options):
    points, boundary = read(options.data / f"{name}.npz")
    base = jf.base_surface(boundary, points, NETS[name], method=jf.Meshless())
    surfaces, captions = [], []
    for title, method in METHODS.items():
        most = 0 if title == "base" else options.max_steps
        fit = jf.approximate(points, base, method, tol_average=options.target, max_steps=most)
        found = fit.regularity
        errors = 100 * float(fit.average_error), 100 * float(fit.maximum_error)
        plate = found.thin_plate_energy / float(fit.stats["diagonal"]) ** 2
        print(
            f"{name:<17}{title:<31}{errors[0]:>10.4f}{errors[1]:>10.3f}{found.folds:>7}"
            f"{np.degrees(found.smallest_angle):>9.2f}{found.curvature_energy:>13.4g}{plate:>12.4g}",
            flush=True,
        )
        surfaces.append(fit.surface)
        captions.append(f"{title}: {errors[0]:.3g} / {errors[1]:.3g} %, {found.folds:,} folds")
    path = options.folder / f"{name}.png"
    zebra_stripes(surfaces, path, captions, title=name, shaded=True)


def main():
    parser = argparse.ArgumentParser(description="base, default and paper, shaded and with zebra stripes")
    parser.add_argument("names", nargs="*", metavar="name", help=", ".join(NETS))
    parser.add_argument("--target", type=float, default=1e-6)
    parser.add_argument("--max-steps", type=int, default=200)
    parser.add_argument("--folder", type=Path, default=Path("."), help="where pictures are written")
    parser.add_argument("--data", type=Path, default=helpers.FOLDER)
    options = parser.parse_args()
    heads = ("average %", "maximum %", "folds", "degrees", "energy (9)", "(10)")
    print("{:<17}{:<31}{:>10}{:>10}{:>7}{:>9}{:>13}{:>12}".format("scan", "surface", *heads))
    for name in options.names or NETS:
        compare(name, options)


if __name__ == "__main__":
    main()
