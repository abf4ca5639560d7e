"""Raw scans: points without a boundary, fitted and trimmed by `fit_points`.

    python -m benchmarks scans [--part sheets held_out outliers cup] [name ...]

`sheets`: what was left out, loops, share of the sheet's points inside them, the trimmed area over that of the
mesh, errors in % of the diagonal inside the loops and of all points, folds inside the loops, seconds of
processor time with compiling.
`held_out`: one point in ten is held out, in three splits; its average error over that of the fitted points,
and where the boundary is known over that of the fit that was given it, on the same net.
`outliers`: one point in a hundred of the Igea face is moved by 3 % of the diagonal along its normal, either
way; the average distance of the two surfaces, at the points.
`cup`: the drawn cup on a net of 33 x 33, without parameters.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxfit as jf
from benchmarks._inputs import arrays_of, diagonal

RAW = ("kinect_head", "lidar_site4", "deepdrawing_cup")
BOUNDED = ("igea_face", "mannequin_head", "mountain", "blade_wrap_3000")
SPLITS = 3
SIDES = ("v0", "v1", "u0", "u1")
STOPS = {"tol_average": 1e-6, "max_steps": 20}  # never met: nets are compared, not tolerances


def row(name, cells):
    """A line of a table, wide enough for the longest number."""
    print(f"{name:<18}" + "".join(f"{cell:>10}" for cell in cells), flush=True)


def percent(errors):
    """Average and largest."""
    return f"{100 * np.nanmean(errors):.4f}", f"{100 * np.nanmax(errors):.3f}"


def sheets(names):
    """Everything that is said of a sheet and its loops."""
    heads = "read dupl. outliers off loops inside area/mesh in:avg max all:avg max folds net cpu/s"
    row("", heads.split())
    for name in names or RAW + BOUNDED:
        points = arrays_of(name)["points"]
        begun = time.process_time()
        fit = jf.fit_points(points)
        spent = time.process_time() - begun
        stats, inside = fit.stats, np.asarray(fit.inside)
        area, errors = float(fit.trimmed.area()), np.asarray(fit.errors)
        counts = [stats[x] for x in ("points_read", "duplicates", "outliers", "off_the_sheet")]
        share = f"{inside[np.asarray(stats['counted'])].mean():.2%}"
        ratio = f"{area / stats['sheet_area']:.4f}"
        figures = *percent(errors[inside]), *percent(errors), fit.folds, "{}x{}".format(*fit.surface.shape)
        row(name, [*counts, len(fit.trimmed.loops), share, ratio, *figures, f"{spent:.0f}"])


def held_out(names):
    """Fits to nine points in ten, judged by the tenth."""
    row("", "split net fitted held_out ratio with_bnd. ratio folds".split())
    for name in names or RAW[::2] + BOUNDED:
        arrays = arrays_of(name)
        points, net, goals = arrays["points"], None, {}
        if name in BOUNDED:
            net, goals = (40, 40) if len(points) > 10_000 else (24, 24), STOPS
            boundary = jf.Boundary(*(arrays[f"boundary_{side}"] for side in SIDES))
        for split in range(SPLITS):
            out = np.zeros(len(points), bool)
            some = np.random.default_rng(split).permutation(len(points))[: len(points) // 10]
            out[some] = True
            fit = jf.fit_points(points[~out], net=net, **goals)
            away, inner = judged(fit.surface, points, out), float(np.asarray(fit.errors)[fit.inside].mean())
            cells = [split, "{}x{}".format(*fit.surface.shape), f"{100 * inner:.4f}", f"{100 * away:.4f}"]
            cells.append(f"{away / inner:.2f}")
            if name in BOUNDED:
                given = jf.fit_points(points[~out], boundary, net=net, **goals)
                known = judged(given.surface, points, out)
                cells += [f"{100 * known:.4f}", f"{away / known:.2f}"]
            row(name, [*cells, fit.folds])


def judged(surface, points, out):
    """Average distance of the points held out, over the diagonal of all."""
    return float(np.mean(jf.closest_point(surface, points[out]).distance)) / diagonal(points)


def outliers(names):
    """Planted along the normals, and by how much they move the surface."""
    row("", "planted found moved% largest%".split())
    for name in names or ("igea_face",):
        points = arrays_of(name)["points"]
        clean = jf.fit_points(points)
        rng = np.random.default_rng(0)
        some = rng.permutation(len(points))[: len(points) // 100]
        normals = np.asarray(clean.surface.normal(clean.u, clean.v))[some]
        signs = rng.choice([-1.0, 1.0], (len(some), 1))
        spoilt = points.copy()
        spoilt[some] += 0.03 * diagonal(points) * signs * normals
        found = jf.fit_points(spoilt)
        at = np.asarray(clean.surface(clean.u, clean.v))
        away = np.asarray(jf.closest_point(found.surface, at).distance) / diagonal(points)
        row(name, [len(some), found.stats["outliers"], *percent(away)])


def cup(names):
    """The example of another library's fit, which was given parameters."""
    row("", "average% maximum% loops folds".split())
    for name in names or ("deepdrawing_cup",):
        fit = jf.fit_points(arrays_of(name)["points"], net=(33, 33))
        row(name, [*percent(np.asarray(fit.errors)), len(fit.trimmed.loops), fit.folds])


PARTS = {"sheets": sheets, "held_out": held_out, "outliers": outliers, "cup": cup}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="data sets (default all)")
    parser.add_argument("--part", nargs="*", default=list(PARTS), choices=PARTS)
    options = parser.parse_args()
    for part in options.part:
        PARTS[part](options.names)


if __name__ == "__main__":
    main()
