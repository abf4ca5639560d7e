"""Many fits of small clouds: `map_fits` by threads and by processes beside Python loops and one program.

All fits take 20 steps from one base surface, and the ways take turns. The first call compiles, or starts
the processes. Inside `jit` the errors of a fit are at local feet; elsewhere they are at true closest points
unless `LocalFeet` are asked for. `difference` is the largest of a control point from the loop over
`approximate`, as a fraction of the diagonal.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxfit as jf
from benchmarks._inputs import diagonal
from benchmarks._referee import judged
from benchmarks._timing import in_turns

STEPS = 20
METHODS = {
    "geometric": jf.GeometricApproximation(),
    "standard": jf.StandardApproximation(smoothing=1e-5),
    "orthogonal": jf.OrthogonalDistance(),
}
OPTIONS = {"tol_average": 0.0, "max_steps": STEPS}


def wavy(x, y):
    """Heights that all clouds share on the border, which the fits hold."""
    return 0.1 * np.sin(3.0 * x + 0.5) * np.cos(2.5 * y)


def made_clouds(count, points):
    """Clouds (count, points, 3) at random places, each with a bump of its own."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(size=(2, count, points))
    bump = rng.uniform(-0.1, 0.1, (count, 1)) * np.sin(np.pi * x) * np.sin(np.pi * y)
    return np.stack([x, y, wavy(x, y) + bump], axis=-1)


def base_of_all(net):
    """A surface with the border of the clouds."""
    knots = [np.asarray(jf.clamped_uniform_knots(n, 4)) for n in net]
    greville = [np.convolve(k[1:-1], np.ones(3) / 3, "valid") for k in knots]
    x, y = np.meshgrid(*greville, indexing="ij")
    return jf.BSplineSurface(np.stack([x, y, wavy(x, y)], axis=-1), *knots)


def nets(fits):
    """Control points of all fits."""
    return np.stack([np.asarray(fit.surface.control_points) for fit in fits])


def ways(method, clouds, base, executor):
    """The ways to fit all clouds; each gives control points."""

    def net(points):
        return jf.approximate(points, base, method, **OPTIONS).surface.control_points

    def side_by_side(**more):
        return nets(jf.map_fits(clouds, base, method, executor=executor, **OPTIONS, **more))

    single, program = jax.jit(net), jax.jit(lambda clouds: jax.lax.map(net, clouds))
    apart, together = list(jnp.asarray(clouds)), jnp.asarray(clouds)
    return {
        "loop, approximate": lambda: np.stack([np.asarray(net(points)) for points in clouds]),
        "loop, jit": lambda: np.stack([np.asarray(single(points)) for points in apart]),
        "lax.map": lambda: np.asarray(program(together)),
        "map_fits, threads": lambda: nets(jf.map_fits(clouds, base, method, **OPTIONS)),
        "map_fits, processes": side_by_side,
        "map_fits, processes, local feet": lambda: side_by_side(errors=jf.LocalFeet()),
    }


def fits(report, options):
    """Each method, each way; the average error is the mean of all fits', by the referee."""
    count, size, net = (8, 300, (8, 8)) if options.quick else (64, 3_000, (11, 15))
    note = f"{count} clouds of {size} points, {net[0]}x{net[1]} control points, {STEPS} steps."
    report.table("Many fits", note)
    clouds, base = made_clouds(count, size), base_of_all(net)
    knots = base.knots_u, base.knots_v
    with jf.worker_processes() as executor:
        for name, method in METHODS.items():
            done = in_turns(ways(method, clouds, base, executor), min(options.runs, 3))
            loop = done["loop, approximate"]
            for way, found in done.items():
                verdicts = [judged(x, knots, points) for x, points in zip(found.result, clouds, strict=True)]
                report.row(
                    method=name,
                    way=way,
                    fits_a_second=count / found.median,
                    times_the_loop=loop.median / found.median,
                    average_percent=float(np.mean([x["average %"] for x in verdicts])),
                    folds=sum(x["folds"] for x in verdicts),
                    difference=float(np.abs(found.result - loop.result).max()) / diagonal(loop.result),
                    **found.cells(),
                )


PARTS = {"fits": fits}
