"""Tables 1 to 3 and Figures 1, 2 and 7 of the paper: interpolation of grids, and symmetry."""

import functools

import numpy as np

import jaxfit as jf
from benchmarks import _inputs
from benchmarks._referee import judged_surface
from benchmarks._timing import in_turns

UNIT = jf.UnitWeights()
PLAIN, HELD, WEIGHTED, BOTH = "plain", "feet held", "repositioning", "both"
METHODS = {
    "standard": jf.StandardInterpolation(),
    PLAIN: jf.GeometricInterpolation(repositioning=UNIT, freeze_after=None),
    HELD: jf.GeometricInterpolation(repositioning=UNIT),
    WEIGHTED: jf.GeometricInterpolation(freeze_after=None),
    BOTH: jf.GeometricInterpolation(),
    "Chebyshev": jf.GeometricInterpolation(repositioning=UNIT, acceleration=jf.Chebyshev()),
}
TOLERANCE = 1e-14
# Of the paper's models: change of the time in Tables 1 and 2 in %, iterations in Table 3.
PAPER = {"hood": (-55, -34, 134), "fuselage 10,000": (-79, -14, 108), "fuselage 40,000": (None, None, 103)}
LEVELS = (1e-5, 1e-7, 1e-9, 1e-11, 1e-13)  # of Figure 7: maximum errors, as fractions of the diagonal
NOISE, WIDTH = 4.0, 1400.0  # mm


def tables(report, options):
    """Tables 1 to 3: the methods on three grids."""
    note = f"Interpolation to {100 * TOLERANCE:g} % of the diagonal; errors by the referee, in %."
    report.table("Tables 1 to 3: interpolation of grids", note)
    for grid in _inputs.grids(options.stand_ins):
        if options.quick and grid.role != "hood":
            continue
        works = {
            name: functools.partial(jf.interpolate, grid.points, method, tolerance=TOLERANCE, max_steps=600)
            for name, method in METHODS.items()
        }
        done = in_turns(works, options.runs)
        for name, found in done.items():
            fit = found.result
            report.row(
                model=f"{grid.role} ({grid.source})",
                method=name,
                iterations=int(fit.stats["num_steps"]),
                **judged_surface(fit.surface, grid.points),
                evaluations=float(np.nansum(np.asarray(fit.history.evaluations))),
                **found.cells(),
            )
        _remarks(report, grid.role, done)


def _remarks(report, role, done):
    """What the accelerations change, beside the paper's figures."""
    held, weighted, steps = PAPER[role]
    for title, name, paper in (("Table 1", HELD, held), ("Table 2", WEIGHTED, weighted)):
        change = 100 * (done[name].median / done[PLAIN].median - 1)
        counts = [int(done[x].result.stats["num_steps"]) for x in (PLAIN, name)]
        beside = "not given" if paper is None else f"{paper} %"
        report.remark(
            f"{title}, {role}, {name}: time {change:+.0f} % (paper: {beside}), "
            f"iterations {counts[0]} -> {counts[1]}"
        )
    ratio = done[BOTH].median / done["standard"].median
    found = int(done[BOTH].result.stats["num_steps"])
    report.remark(
        f"Table 3, {role}: {found} iterations (paper: {steps}), {ratio:.1f} times the standard method's time"
    )


def figure_1(report, options):
    """A noisy hood with and without a plane of symmetry; asymmetry as a fraction of the diagonal."""
    report.table(
        "Figure 1: reflectional symmetry", f"The hood, {WIDTH:g} mm wide, with {NOISE:g} mm of noise."
    )
    hood = next(iter(_inputs.grids(options.stand_ins)))
    grid = hood.points * (WIDTH / np.ptp(hood.points[..., 0]))
    noisy = grid + np.random.default_rng(1).normal(scale=NOISE, size=grid.shape)
    reflection = jf.Reflection(0)
    surfaces = []
    for caption, symmetry in (("free", None), ("symmetric", reflection)):
        fit = jf.interpolate(noisy, jf.GeometricInterpolation(symmetry=symmetry))
        net = np.asarray(fit.surface.control_points)
        moved = np.linalg.norm(np.asarray(fit.surface(fit.u, fit.v)) - noisy, axis=-1).max()
        report.row(
            model=f"{hood.role} ({hood.source})",
            method=caption,
            converged=bool(fit.converged),
            iterations=int(fit.stats["num_steps"]),
            asymmetry=float(reflection.located(net).asymmetry(net)) / _inputs.diagonal(noisy),
            farthest_mm=float(moved),
        )
        surfaces.append(fit.surface)
    if options.pictures:
        from jaxfit.plot import zebra_stripes

        zebra_stripes(surfaces, options.pictures / "figure1.png", ["free", "symmetric"], title="noisy hood")


def figure_2(report, options):
    """Steps of the closest-point search and changes of the parameters, iteration by iteration."""
    note = (
        "Evaluations a point, and mean change of a foot's u + v, after so many iterations; feet never held."
    )
    report.table("Figure 2: closest points while the surface moves", note)
    for grid in _inputs.grids(options.stand_ins):
        if options.quick and grid.role != "hood":
            continue
        method = jf.GeometricInterpolation(repositioning=UNIT, freeze_after=None, foot_method=jf.HuWallner())
        history = jf.interpolate(grid.points, method, tolerance=TOLERANCE, max_steps=600).history
        for step in (1, 2, 3, 5, 10, 20, 50, 100):
            if step < len(history.average):
                report.row(
                    model=f"{grid.role} ({grid.source})",
                    iteration=step,
                    evaluations=float(history.evaluations[step]),
                    change=float(history.change[step]),
                    average_percent=100 * float(history.average[step]),
                )


def figure_7(report, options):
    """Time to an average error on two sizes of the fuselage; quickly, on the hood."""
    note = "The geometric method ended at maximum errors a hundred times apart. Errors by the referee, in %."
    report.table("Figure 7: time against average error", note)
    for grid in _inputs.grids(options.stand_ins):
        if (grid.role == "hood") != options.quick:
            continue
        through = functools.partial(jf.interpolate, grid.points)
        works = {("standard", TOLERANCE): functools.partial(through, METHODS["standard"])}
        for name in (BOTH, "Chebyshev"):
            for level in LEVELS:
                works[name, level] = functools.partial(through, METHODS[name], tolerance=level, max_steps=600)
        for (name, _), found in in_turns(works, options.runs).items():
            fit = found.result
            report.row(
                model=f"{grid.role} ({grid.source})",
                method=name,
                iterations=int(fit.stats["num_steps"]),
                **judged_surface(fit.surface, grid.points),
                **found.cells(),
            )
