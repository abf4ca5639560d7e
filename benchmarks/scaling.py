"""Time and error by the number of points, and by the number of control points, on a made height field."""

import functools

import numpy as np

import jaxfit as jf
from benchmarks._referee import judged_surface
from benchmarks._timing import timed

COUNTS = (1_000, 10_000, 100_000, 1_000_000)
NETS = (10, 20, 40, 80)
STEPS = 10
METHODS = {
    "geometric": jf.GeometricApproximation(),
    "standard": jf.StandardApproximation(smoothing=1e-6),
    "orthogonal distance": jf.OrthogonalDistance(),
}


def cloud(count):
    """Points at random places of a height field, and its boundary."""

    def height(x, y):
        return np.stack([x, y, 0.1 * np.sin(9 * x + 0.5) * np.cos(7 * y)], axis=-1)

    line, zero, one = np.linspace(0, 1, 200), np.zeros(200), np.ones(200)
    ends = ((line, zero), (line, one), (zero, line), (one, line))
    return height(*np.random.default_rng(0).uniform(size=(2, count))), jf.Boundary(
        *(height(*x) for x in ends)
    )


def _row(report, count, net, name, runs):
    points, boundary = cloud(count)
    base = jf.base_surface(boundary, net=(net, net))
    options = dict(tol_average=0.0, max_steps=STEPS)
    found = timed(functools.partial(jf.approximate, points, base, METHODS[name], **options), runs)
    cells = judged_surface(found.result.surface, points[:: max(1, count // 100_000)])
    per_point = 1e6 * found.median / count
    report.row(method=name, points=count, net=f"{net}x{net}", **cells, us_a_point=per_point, **found.cells())


def points(report, options):
    """A net of 30 x 30 and more and more points."""
    note = f"{STEPS} steps each, from the Coons surface. Errors by the referee at up to 100,000 points, in %."
    report.table("Scaling with the points", note)
    for name in METHODS:
        for count in COUNTS[: 2 if options.quick else None]:
            _row(report, count, 30, name, options.runs)


def nets(report, options):
    """Clouds of 20,000 points and larger and larger nets."""
    report.table("Scaling with the net", f"20,000 points, {STEPS} steps each, from the Coons surface.")
    for name in METHODS:
        for net in NETS[: 2 if options.quick else None]:
            _row(report, 20_000, net, name, options.runs)


PARTS = {"points": points, "nets": nets}
