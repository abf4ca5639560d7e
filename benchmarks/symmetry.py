"""Reflectional symmetry of a noisy hood: Figure 1 of the paper, in numbers and as a picture.

    python benchmarks/symmetry.py [--noise 4.0] [--picture symmetry.png] [--data FOLDER] [--work FOLDER]

A hood in millimetres, its points displaced at random, is interpolated freely and with `Reflection`:
iterations, largest error, and the largest distance of the control net from its mirror image, as a fraction
of the diagonal. The hood is `hood.npy` of the work folder of an independent implementation, and the digitised
one among the data, scaled to a width of 1.4 m. The picture shows the zebra stripes of both surfaces, seen
along the plane of symmetry.
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
from jaxfit.plot import zebra_stripes

WIDTH = 1400.0  # mm


def hoods(options):
    """Names and grids, in millimetres."""
    if options.work and (options.work / "hood.npy").is_file():
        yield "hood", np.load(options.work / "hood.npy")
    path = options.data / "hood_beetle_10x10.npz"
    if path.is_file():
        grid = np.load(path)["grid"]
        yield path.stem, grid * (WIDTH / np.ptp(grid[..., 0]))


def report(name, grid, reflection):
    """Fit freely and symmetrically, print, and return both surfaces."""
    size = helpers.diagonal(grid)
    surfaces = []
    for caption, symmetry in (("free", None), ("symmetric", reflection)):
        fit = jf.interpolate(grid, jf.GeometricInterpolation(symmetry=symmetry))
        surfaces.append(fit.surface)
        net = np.asarray(fit.surface.control_points)
        asymmetry = float(reflection.located(net).asymmetry(net)) / size
        moved = np.linalg.norm(np.asarray(fit.surface(fit.u, fit.v)) - grid, axis=-1).max()
        error, steps = 100 * float(fit.maximum_error), int(fit.stats["num_steps"])
        print(
            f"{name}, {caption:<10}{steps:>5} iterations, error {error:.1e} %, asymmetry {asymmetry:.1e}, "
            f"farthest from the noisy data {moved:.2f} mm, {fit.message}"
        )
    return surfaces


def main():
    """Print the numbers and save the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--noise", type=float, default=4.0, help="standard deviation in mm")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--picture", type=Path, default=Path("symmetry.png"))
    parser.add_argument("--data", type=Path, default=helpers.FOLDER, help="folder of the .npz files")
    parser.add_argument("--work", type=Path, help="folder of grids (.npy) of an independent implementation")
    options = parser.parse_args()
    drawn = None
    for name, grid in hoods(options):
        noisy = grid + np.random.default_rng(options.seed).normal(scale=options.noise, size=grid.shape)
        # The rows run across the car, or the columns: whichever come closer to their mirror images.
        ways = [jf.Reflection(axis) for axis in (0, 1)]
        gaps = [float(way.asymmetry(grid)) if clear(way, grid) else np.inf for way in ways]
        reflection = ways[int(np.argmin(gaps))]
        surfaces = report(name, noisy, reflection)
        if drawn is None:
            drawn = name, surfaces, reflection.located(noisy)
    if drawn is None:
        print(f"no hood in {options.data}: nothing to do")
        return
    name, surfaces, plane = drawn
    title = f"{name} with {options.noise:g} mm noise"
    way = np.linspace(0, 1, 30)
    u, v = (x.ravel() for x in np.meshgrid(way, way))
    across = np.asarray(plane.normal)
    outward = np.asarray(surfaces[1].normal(u, v)).mean(axis=0)
    view = outward - (outward @ across) * across
    captions = ["free", "symmetric"]
    zebra_stripes(
        surfaces, options.picture, captions, view=view, direction=np.cross(across, view), title=title
    )
    print(f"zebra stripes of both: {options.picture}")


def clear(way, grid):
    """Whether the pairing has a plane at all."""
    try:
        way.plane(grid)
    except ValueError:
        return False
    return True


if __name__ == "__main__":
    main()
