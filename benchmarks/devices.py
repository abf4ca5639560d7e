"""A cloud divided among devices: one host with several of them, or several processes.

    python benchmarks/devices.py [--points 200000] [--net 42 42] [--devices 8] [--steps 10]
        [--method orthogonal|geometric|standard]
    python benchmarks/devices.py --processes 2 --process 0 --address HOST:PORT ...  # one for each process

Without accelerators `--devices` simulates so many on each host; these share its cores, so that times say
what dividing costs, not what it gains. Each process makes and keeps points of its own. Printed by the first
one are seconds of the first fit, which compiles, and of a second one, and its errors.
"""

import argparse
import os
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]


def parsed():
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=200_000, help="of all processes together")
    parser.add_argument("--net", type=int, nargs=2, default=[42, 42])
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--method", choices=["orthogonal", "geometric", "standard"], default="orthogonal")
    parser.add_argument("--devices", type=int, help="simulated ones on each host (default: those there are)")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--process", type=int, default=0, help="the number of this one")
    parser.add_argument("--address", default="localhost:12345", help="of the first process")
    return parser.parse_args()


def main():
    """Two fits of the divided cloud."""
    options = parsed()
    if options.devices:
        flag = f"--xla_force_host_platform_device_count={options.devices}"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()
    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    if options.processes > 1:
        jax.distributed.initialize(options.address, options.processes, options.process)
    import jaxfit as jf
    from benchmarks._timing import timed
    from benchmarks.scaling import METHODS, cloud

    mesh = jax.make_mesh((jax.device_count(),), ("points",))
    share, boundary = cloud(options.points // options.processes, seed=options.process)
    points, weights = jf.shard_points(share, mesh)
    base = jf.base_surface(boundary, net=tuple(options.net))
    method = {name.split()[0]: value for name, value in METHODS.items()}[options.method]

    def fit():
        limits = dict(tol_average=0.0, max_steps=options.steps)
        return jf.approximate(points, base, method, weights=weights, errors=jf.AtParameters(), **limits)

    found = timed(fit, 1)
    if jax.process_index() == 0:
        fit = found.result
        place = f"{jax.process_count()} processes, {jax.device_count()} devices"
        print(f"{place}; {points.shape[0]:,} points, {options.net[0]} x {options.net[1]} control points")
        print(
            f"first fit {found.first:.2f} s, second {found.median:.2f} s; errors: {fit.errors.sharding.spec}"
        )
        print(f"average error {100 * float(np.asarray(fit.average_error)):.4f} %, {fit.message}")


if __name__ == "__main__":
    main()
