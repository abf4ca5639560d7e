"""A fit by two processes, for `test_devices.py`: the first one prints what it found as JSON."""

import json
import sys

import jax
import numpy as np
from helpers import noisy_sheet

import jaxfit as jf

FIRST = 1501  # points of the first process; all are 2,500
METHODS = (jf.StandardApproximation(), jf.OrthogonalDistance())


def main():
    """The same fit by both processes, each with its own points, and by this one alone."""
    process, address = int(sys.argv[1]), sys.argv[2]
    jax.distributed.initialize(address, num_processes=2, process_id=process)
    cloud, base = noisy_sheet(2500, (8, 7))
    own = cloud[:FIRST] if process == 0 else cloud[FIRST:]
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
        found.append(
            {"apart": apart, "rows": fit.errors.shape[0], "devices": len(fit.errors.sharding.device_set)}
        )
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
