"""A fit by two processes, for `test_devices.py`: the first one prints what it found as JSON."""

import json
import sys

import jax
import numpy as np

PROCESS, ADDRESS = int(sys.argv[1]), sys.argv[2]
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
jax.distributed.initialize(ADDRESS, num_processes=2, process_id=PROCESS)

from helpers import wavy_cloud

import jaxfit as jf

FIRST = 1501  # points of the first process; all are 2,500
METHODS = (jf.StandardApproximation(), jf.OrthogonalDistance())


def main():
    """The same fit by both processes, each with its own points, and by this one alone."""
    cloud, edges = wavy_cloud(2500)
    cloud = cloud + 1e-3 * np.random.default_rng(1).normal(size=cloud.shape)
    base = jf.base_surface(jf.Boundary(**edges), net=(8, 7))
    own = cloud[:FIRST] if PROCESS == 0 else cloud[FIRST:]
    points, weights = jf.shard_points(own, jax.make_mesh((jax.device_count(),), ("points",)))
    found = []
    for method in METHODS:
        options = dict(tol_average=0.0, max_steps=4)
        fit = jf.approximate(points, base, method, weights=weights, **options)
        one = jf.approximate(cloud, base, method, **options)
        pairs = [
            (fit.surface.control_points, one.surface.control_points),
            (fit.average_error, one.average_error),
            (fit.maximum_error, one.maximum_error),
            (fit.history.average, one.history.average),
        ]
        apart = max(float(np.abs(np.asarray(x) - np.asarray(y)).max()) for x, y in pairs)
        found.append({"apart": apart, "rows": fit.errors.shape[0], "devices": len(fit.errors.sharding.device_set)})
    print(json.dumps(found))


if __name__ == "__main__":
    main()
