"""`Projector`: local feet of some points of a cloud, padded to common sizes, on the host."""

from functools import cached_property, partial
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxfit._cells import values_at
from jaxfit._closest._chunks import HostFeet, in_chunks, neighbours_together, padded
from jaxfit._closest._foot_methods import AbstractFootMethod
from jaxfit._closest._project import project
from jaxfit._compile import compiled
from jaxfit._remembered import remembered
from jaxfit._splines._pieces import Axis, Pieces, pieces_on

LAST_SURFACES = 2  # whose polynomial pieces and samples are remembered


@partial(compiled, kept=True, static_argnums=(0, 1))
def _run(
    method: AbstractFootMethod,
    borders: bool,
    pieces: Pieces,
    target: Array,
    u: Array,
    v: Array,
    idle: Array,
    tolerance: Array,
    max_steps: Array,
) -> dict[str, Array]:
    """Local feet, also on the `borders`: few clouds have feet that need them, so that is another program."""
    feet = project(method, pieces, target, u, v, tolerance, max_steps, idle, borders)
    return {
        "u": feet.best_u,
        "v": feet.best_v,
        "f": feet.squared_distance,
        "converged": feet.converged,
        "steps": feet.steps,
        "point": values_at(pieces, feet.best_u, feet.best_v),
    }


@remembered(LAST_SURFACES)
def _remembered_pieces(net: np.ndarray, axis_u: Axis, axis_v: Axis) -> Pieces:
    return jax.device_put(pieces_on(net, axis_u, axis_v))


class Projector:
    """Local feet of some of the points from starts, always in the same shapes.

    Lengths are in a `unit`, a power of two near the extent: in single precision squares of very small or
    large numbers would be 0 or infinite.
    """

    def __init__(
        self,
        method: AbstractFootMethod,
        net: Any,
        axes: tuple[Axis, Axis],
        points: np.ndarray,
        tolerance: float,
        max_steps: int,
        size: int,
    ):
        self.method, self.axes, self.dtype, self.size = method, axes, np.dtype(net.dtype), size
        net = np.asarray(net, np.float64)
        self.centre = _middle(net)
        self.net = net - self.centre
        self.centred = np.empty(points.shape[::-1])
        np.subtract(points.T, self.centre[:, None], out=self.centred)
        box = _box(self.net, self.centred)
        self.unit = float(np.ldexp(1.0, np.frexp(box.max())[1] - 1)) if 0 < box.max() < np.inf else 1.0
        self.net /= self.unit
        self.centred /= self.unit
        extent = self.dtype.type(tolerance * np.linalg.norm(box / self.unit))
        self.limits = extent, np.int32(max_steps)

    @cached_property
    def pieces(self) -> Pieces:
        """The surface, made only if there is anything to project."""
        return _remembered_pieces(self.net.astype(self.dtype), *self.axes)

    def compile_ahead(self) -> None:
        """Begin to compile the program that the calls take, if that has not been done."""
        nothing = np.zeros((self.net.shape[2], self.size), self.dtype)
        idle = np.zeros(self.size, bool)
        _run.ahead(self.method, False, self.pieces, nothing, nothing[0], nothing[0], idle, *self.limits)

    def __call__(self, which: Any, u: Any, v: Any, borders: bool = False) -> HostFeet:
        """Feet of the points `which` (None: all) from (u, v)."""
        self.pieces  # noqa: B018 (before there are threads)
        chosen = self.centred if which is None else self.centred[:, which]
        one = partial(self._feet_of_chunk, borders)
        u, v = np.asarray(u), np.asarray(v)
        # A chunk of neighbours has fuller rows and stays in fewer cells.
        order = neighbours_together(self.axes, u, v) if u.size > self.size else None
        return in_chunks(one, (chosen, u, v), self.size, order)

    def _feet_of_chunk(self, borders: bool, *inputs: np.ndarray) -> dict[str, Array]:
        idle = np.arange(self.size) >= inputs[0].shape[-1]
        inputs = tuple(padded(x, self.size).astype(self.dtype, copy=False) for x in inputs)
        return _run(self.method, borders, self.pieces, *inputs, idle, *self.limits)


def _middle(net: np.ndarray) -> np.ndarray:
    """Centre of the box around the net, about which coordinates carry the least rounding."""
    return 0.5 * (net.min(axis=(0, 1)) + net.max(axis=(0, 1)))


def _box(net: np.ndarray, centred: np.ndarray) -> np.ndarray:
    """The sides of the box around control points and queries."""
    low = np.minimum(net.min(axis=(0, 1)), centred.min(axis=1))
    high = np.maximum(net.max(axis=(0, 1)), centred.max(axis=1))
    return high - low
