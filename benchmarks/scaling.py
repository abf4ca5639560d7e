"""Time and error by the number of points, and by the number of control points, on a made height field."""

import functools
import time

import jax
import numpy as np

import jaxfit as jf
from benchmarks._referee import judged_surface

COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
NETS = (10, 20, 40, 80, 140, 200)
POINTS, NET = 20_000, 30  # held while the other changes
STEPS = (2, 6)  # a pass is the time between fits of so many iterations, over their difference
METHODS = {
    "geometric": jf.GeometricApproximation(),
    "standard": jf.StandardApproximation(smoothing=1e-6),
    "orthogonal distance": jf.OrthogonalDistance(),
}


def cloud(count, seed=0):
    """Points at random places of a height field, and its boundary."""

    def height(x, y):
        return np.stack([x, y, 0.1 * np.sin(9 * x + 0.5) * np.cos(7 * y)], axis=-1)

    line, zero, one = np.linspace(0, 1, 200), np.zeros(200), np.ones(200)
    ends = ((line, zero), (line, one), (zero, line), (one, line))
    return height(*np.random.default_rng(seed).uniform(size=(2, count))), jf.Boundary(
        *(height(*x) for x in ends)
    )


def fit_of(points, base, method, steps):
    """A fit of so many iterations, from given feet and without a last search, which no pass contains."""
    start = points[:, 0].copy(), points[:, 1].copy()
    options = dict(tol_average=0.0, start=start, errors=jf.AtParameters())
    return jf.approximate(points, base, method, max_steps=steps, **options)


def clocked(work):
    """Seconds of a call, and those of all cores together, which other work on the machine disturbs less."""
    begun = time.perf_counter(), time.process_time()
    jax.block_until_ready(work())
    return time.perf_counter() - begun[0], time.process_time() - begun[1]


def pass_times(points, base, method, runs):
    """Seconds of one iteration, and of all cores: from the shortest fits of few and of more. And a fit."""
    works = [functools.partial(fit_of, points, base, method, steps) for steps in STEPS]
    fits = [work() for work in works]
    times = np.array([[clocked(work) for work in works] for _ in range(max(runs, 1))])
    made = [int(fit.stats["num_steps"]) for fit in fits]
    few, more = np.min(times, axis=0)
    return (more - few) / max(made[1] - made[0], 1), fits[1]


def _row(report, count, net, name, runs):
    points, boundary = cloud(count)
    base = jf.base_surface(boundary, net=(net, net))
    (a_pass, of_cores), fit = pass_times(points, base, METHODS[name], runs)
    errors = judged_surface(fit.surface, points[:: max(1, count // 100_000)])
    times = dict(pass_ms=1e3 * a_pass, of_all_cores_ms=1e3 * of_cores, ns_a_point=1e9 * of_cores / count)
    report.row(method=name, points=count, net=f"{net}x{net}", **times, **errors)
    return of_cores


def _scaled(report, options, sizes, what, row):
    """Rows for growing sizes, and the slope of each method in a picture with logarithmic axes."""
    lines = {name: [row(size, name) for size in sizes] for name in METHODS}
    for name, times in lines.items():
        last = len(sizes) // 2
        if len(sizes) < 4:  # no slope of two halves
            continue
        slopes = [_slope(sizes[part], times[part]) for part in (slice(None), slice(last, None))]
        growth = f"{what}^{slopes[0]:.2f}, from {sizes[last]:,} on like {what}^{slopes[1]:.2f}"
        report.remark(f"{name}: the time of all cores in a pass grows like {growth}.")
    if options.pictures:
        _draw(options.pictures / f"scaling_{what}.png", sizes, lines, what)


def _slope(sizes, times):
    """Of the line through the logarithms."""
    times = np.maximum(times, 1e-9)
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0]) if len(sizes) > 1 else float("nan")


def _draw(path, sizes, lines, what):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, times in lines.items():
        axes.loglog(sizes, times, "o-", label=f"{name}, slope {_slope(sizes, times):.2f}")
    axes.set(xlabel=what.replace("_", " "), ylabel="seconds of all cores a pass")
    axes.legend()
    axes.grid(which="both", alpha=0.3)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def points(report, options):
    """A net of 30 x 30 and more and more points."""
    note = (
        f"{STEPS[1]} steps each, from the Coons surface. Errors by the referee at up to 100,000 points, in %."
    )
    report.table("Scaling with the points", note)
    sizes = COUNTS[: 2 if options.quick else None]
    _scaled(report, options, sizes, "points", lambda x, name: _row(report, x, NET, name, options.runs))


def nets(report, options):
    """Clouds of 20,000 points and larger and larger nets."""
    note = f"{POINTS:,} points, {STEPS[1]} steps each, from the Coons surface."
    report.table("Scaling with the net", note)
    sizes = [n * n for n in NETS[: 2 if options.quick else None]]

    def row(size, name):
        return _row(report, POINTS, round(size**0.5), name, options.runs)

    _scaled(report, options, sizes, "control_points", row)


PARTS = {"points": points, "nets": nets}
