"""Fits on eight simulated devices, for `test_devices.py`: prints what it found as JSON."""

import json
import re
import sys

import jax
import numpy as np
from helpers import noisy_sheet

import jaxfit as jf
from jaxfit._approximation import _sharded_fit

COUNT, CLOUDS, NET = 20_001, 8, (7, 6)  # so coarse that rounding is hardly magnified
METHODS = {
    "geometric": jf.GeometricApproximation(),
    "standard": jf.StandardApproximation(),
    "orthogonal": jf.OrthogonalDistance(),
}
OPTIONS = dict(tol_average=0.0, max_steps=5)
MESH = jax.make_mesh((CLOUDS,), ("points",))
ALL, BASE = noisy_sheet(COUNT, NET)
RUN = _sharded_fit.run_on_devices


def apart(one, other):
    return float(np.abs(np.asarray(one) - np.asarray(other)).max())


def collectives(text):
    """What goes between devices: the kind, how many numbers, and whether it is done in every iteration."""
    kinds = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter|collective-broadcast"
    found = re.findall(rf"= (.*?) (?:{kinds})(?:-start)?\((.*)", text)
    for shapes, rest in found:
        sizes = [np.prod([int(n) for n in x.split(",") if n]) for x in re.findall(r"\[([\d,]*)\]", shapes)]
        yield int(sum(sizes)), "while/body" in rest


def on_all_devices(method, base, options):
    """The fit on all devices, and what its program sends."""
    texts = []

    def run(*args):
        program = jax.jit(RUN.__wrapped__, static_argnums=(0, 1, 2, 3)).lower(*args).compile()
        texts.append(program.as_text())
        return program(*args[4:])

    _sharded_fit.run_on_devices = run
    points, weights = jf.shard_points(ALL, MESH)
    fit = jf.approximate(points, base, method, weights=weights, **options)
    _sharded_fit.run_on_devices = RUN
    return fit, list(collectives(texts[0]))


def compared(method):
    """The fit on all devices beside that on one."""
    fit, sent = on_all_devices(method, BASE, OPTIONS)
    one = jf.approximate(ALL, BASE, method, **OPTIONS)
    history = [
        apart(getattr(fit.history, x), getattr(one.history, x)) for x in ("average", "maximum", "active")
    ]
    return {
        "net": apart(fit.surface.control_points, one.surface.control_points),
        "errors": max(apart(np.asarray(fit.errors)[:COUNT], one.errors), *history),
        "feet": max(apart(np.asarray(x)[:COUNT], y) for x, y in ((fit.u, one.u), (fit.v, one.v))),
        "averages": max(
            apart(fit.average_error, one.average_error), apart(fit.maximum_error, one.maximum_error)
        ),
        "result": str(fit.message) == str(one.message),
        "rows": [x.sharding.shard_shape(x.shape)[0] for x in (fit.u, fit.v, fit.errors)],
        "sent": sent,
    }


def on_a_large_net():
    """Its system is solved by iterations."""
    base, method = noisy_sheet(COUNT, (42, 42))[1], METHODS["orthogonal"]
    options = OPTIONS | {"max_steps": 2}
    fit, sent = on_all_devices(method, base, options)
    one = jf.approximate(ALL, base, method, **options)
    return {"net": apart(fit.surface.control_points, one.surface.control_points), "sent": sent}


DIVIDED = jf.shard_points(ALL, MESH)[1]
REFUSED = {
    "adjoint": dict(adjoint=jf.ImplicitAdjoint()),
    "progress": dict(progress=lambda *_: None),
    "insertion": dict(method=jf.OrthogonalDistance(insertion=jf.KnotInsertion())),
    "loss": dict(method=jf.GeometricApproximation(loss=jf.Tukey())),
    "weights": dict(weights=-np.ones(COUNT + 7)),
    "number of weights": dict(weights=np.ones(COUNT)),
    "length of start": dict(start=2 * jf.shard_points(ALL[:80], MESH)[1:]),
    "start": dict(start=(DIVIDED, 5 * DIVIDED)),
    "points": dict(weights=np.nan * DIVIDED),
}


def refusal(options):
    """The sentence that a fit is refused with."""
    points, weights = jf.shard_points(ALL, MESH)
    try:
        jf.approximate(points, BASE, **{"weights": weights, **options})
    except ValueError as error:
        return str(error)


def fits_of(method):
    """A function of clouds (clouds, points, 3): their nets, for a user's own `shard_map`."""

    def net(points):
        return jf.approximate(points, BASE, method, **OPTIONS).surface.control_points

    return lambda clouds: jax.lax.map(net, clouds)


def shared(method):
    part = jax.sharding.PartitionSpec("points")
    return jax.jit(jax.shard_map(fits_of(method), mesh=MESH, in_specs=part, out_specs=part))


def main():
    """Everything, as one line."""
    found = {name: compared(method) for name, method in METHODS.items()}
    found["large"] = on_a_large_net()
    found["refused"] = {name: refusal(options) for name, options in REFUSED.items()}
    clouds = ALL[: CLOUDS * 300].reshape(CLOUDS, 300, 3)
    where = jax.sharding.NamedSharding(MESH, jax.sharding.PartitionSpec("points"))
    clouds_there = jax.device_put(clouds, where)
    for method in (jf.GeometricApproximation.paper(), jf.OrthogonalDistance(loss=jf.Huber())):
        shared(method).lower(clouds_there)  # JAX checks what varies from device to device
    nets = np.asarray(shared(METHODS["standard"])(clouds_there))
    found["batch"] = apart(nets, jax.jit(fits_of(METHODS["standard"]))(clouds))
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
