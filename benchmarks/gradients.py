"""What a gradient through a fit costs, beside the fit, and whether central differences agree."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxfit as jf
from benchmarks import _inputs
from benchmarks._referee import judged_surface
from benchmarks._timing import in_turns
from benchmarks.scaling import cloud

CASES = ((300, 8), (3_000, 16))
METHODS = {
    "standard": jf.StandardApproximation(smoothing=1e-4),
    "orthogonal distance": jf.OrthogonalDistance(smoothing=1e-5),
}
GRID_METHODS = {"geometric": jf.GeometricInterpolation(), "standard": jf.StandardInterpolation()}


def fits(report, options):
    """Gradient of a height of the fitted surface in all points and in lambda."""
    note = (
        "`agreement`: relative difference from a central difference along a random direction of the points. "
        "No derivative can be trusted where `stationarity`, of the fit at rest, is not small."
    )
    report.table("Gradients of fits of clouds", note)
    for count, net in CASES[: 1 if options.quick else None]:
        points, boundary = cloud(count)
        points = points + 0.003 * np.random.default_rng(1).normal(size=points.shape)
        base = jf.base_surface(boundary, net=(net, net))
        for name, method in METHODS.items():
            try:
                _row(report, "made, noisy", points, base, name, method, options.runs)
            except ArithmeticError as refusal:
                report.remark(f"{name}, {count} points, {net}x{net}: {refusal}")
    if not options.quick:
        head = list(_inputs.clouds(options.stand_ins))[1]
        base = jf.base_surface(head.boundary, head.points, net=head.net, method=jf.Meshless())
        name = "orthogonal distance"
        _row(report, f"head ({head.source})", head.points, base, name, METHODS[name], options.runs)


def _row(report, model, points, base, name, method, runs):
    def fitted(points, adjoint=None):
        return jf.approximate(points, base, method, tol_average=1e-12, max_steps=40, adjoint=adjoint)

    def height(points, adjoint=None):
        return jnp.sum(fitted(points, adjoint).surface(jnp.array([0.3, 0.6]), jnp.array([0.4, 0.7]))[..., 2])

    works = {"fit": lambda: fitted(points), "gradient": lambda: jax.grad(height)(jnp.asarray(points))}
    done = in_turns(works, runs)
    report.row(
        method=name,
        model=model,
        points=len(points),
        net="{}x{}".format(*base.shape),
        **judged_surface(done["fit"].result.surface, points),
        fit_first_s=done["fit"].first,
        gradient_first_s=done["gradient"].first,
        fit_s=done["fit"].median,
        gradient_s=done["gradient"].median,
        lowest_s=min(done["gradient"].later),
        highest_s=max(done["gradient"].later),
        in_fits=done["gradient"].median / done["fit"].median,
        differences_in_fits=2 * points.size,
        stationarity=float(fitted(points, jf.ImplicitAdjoint()).stats["stationarity"]),
        # The derivative is that of the fit at rest, which an explicit adjoint returns.
        agreement=_agreement(lambda x: height(x, jf.ImplicitAdjoint()), points, done["gradient"].result),
    )


def _agreement(height, x, gradient):
    """Relative difference of the slope along a random direction from a central difference."""
    direction = np.random.default_rng(2).normal(size=x.shape)
    ends = [float(height(x + step * direction)) for step in (1e-6, -1e-6)]
    return abs(float(jnp.sum(gradient * direction)) / ((ends[0] - ends[1]) / 2e-6) - 1)


def grids(report, options):
    """Gradient of a height of an interpolating surface in all points of a grid.

    These are not quite even: feet just on the border would make kinks.
    """
    report.table("Gradients of fits of grids")
    for n in (10,) if options.quick else (10, 40):
        x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n + 2), indexing="ij")
        grid = np.stack([x, y, 0.1 * np.sin(5 * x) * np.cos(4 * y)], axis=-1)
        grid = jnp.asarray(grid + 0.02 / n * np.random.default_rng(1).normal(size=grid.shape))
        for name, method in GRID_METHODS.items():
            _grid_row(report, grid, name, method, options.runs)


def _grid_row(report, grid, name, method, runs):
    def height(grid):
        return jf.interpolate(grid, method).surface(0.3, 0.7)[2]

    done = in_turns({"fit": lambda: height(grid), "gradient": lambda: jax.grad(height)(grid)}, runs)
    report.row(
        method=name,
        points=grid.shape[0] * grid.shape[1],
        **judged_surface(jf.interpolate(grid, method).surface, grid),
        fit_s=done["fit"].median,
        gradient_s=done["gradient"].median,
        in_fits=done["gradient"].median / done["fit"].median,
        agreement=_agreement(height, grid, done["gradient"].result),
    )


PARTS = {"fits": fits, "grids": grids}
