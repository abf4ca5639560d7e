"""`Passes`: one pass over the blocks after the other, each with the same compiled program for all blocks."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import Array

from jaxfit._approximation._errors import AbstractErrors
from jaxfit._closest import closest_point
from jaxfit._compile import compiled
from jaxfit._cores import cores
from jaxfit._fit._foot_points import FootPoints
from jaxfit._fit._method import Iterate
from jaxfit._fit._method_fields import static_and_numbers
from jaxfit._fit._problem import Problem, Tolerances, make_problem
from jaxfit._fit._scaling import Unit
from jaxfit._precision import bucket, working_dtype
from jaxfit._splines import BSplineSurface
from jaxfit._streams._blocks import Blocks, Points
from jaxfit._streams._stored_feet import StoredFeet

# Blocks at a time. More would take memory, and a search for first feet has threads of its own.
MOST_THREADS = 4


class Measured(NamedTuple):
    """Sums over the points of one block, or of all of them."""

    sums: Any  # of the method
    totals: Any  # errors, evaluations and changes, and their number
    maximum: Any  # error
    active: Any  # points
    exact: Any  # whether errors are none that are predicted


class Passes:
    """Measures surfaces on all points. Only feet are kept from one pass to the next."""

    def __init__(
        self,
        blocks: Blocks,
        weights: np.ndarray | None,
        unit: Unit,
        tolerances: Tolerances,
        feet: StoredFeet,
        method: Any,
    ):
        assert blocks.count is not None
        self.blocks, self.weights, self.unit, self.tolerances = blocks, weights, unit, tolerances
        self.feet, self.method = feet, method
        self.size = min(blocks.size, bucket(blocks.count))
        self.counted = blocks.count if weights is None else int(np.count_nonzero(weights))
        self.made = 0  # passes

    def measure(self, iterate: Iterate, exact: Any, base: BSplineSurface | None) -> Measured:
        """The sums over all points; feet are searched on `base` if it is given, or start from the last."""
        surface, state = jax.device_put((iterate.surface, iterate.state))
        iterate = Iterate(surface, iterate.projection, state, iterate.step)

        def one(block: tuple[int, Points]) -> Measured:
            start, points = block
            projection, measured = self._measured(start, points, iterate, exact, base)
            count = len(points)
            self.feet.write(start, np.asarray(projection.u)[:count], np.asarray(projection.v)[:count])
            return jax.tree.map(np.asarray, measured)

        self.made += 1
        total: Any = None
        for found in in_threads(one, self.blocks):
            largest = found.maximum if total is None else np.maximum(total.maximum, found.maximum)
            total = found if total is None else jax.tree.map(np.add, total, found)
            total = total._replace(maximum=largest)
        return total

    def finish(
        self, iterate: Iterate, surface: BSplineSurface, errors: AbstractErrors, search: bool
    ) -> tuple[float, float, int]:
        """Store the last feet and errors; average and maximum error, and how many feet have not converged.

        `surface` is the iterate's in the user's unit. With `search` feet are searched on it anew.
        """

        rounding = float(self.unit.loss(np.asarray(surface.control_points)))

        def one(block: tuple[int, Points]) -> tuple[float, float, int]:
            start, points = block
            here, _ = self._measured(start, points, iterate, np.asarray(True), surface if search else None)
            parts = (np.asarray(x) for x in (here.u, here.v, here.error, here.converged))
            u, v, error, converged = parts
            known = u, v, error * self.unit.scale, converged
            found = errors.feet(surface, _padded(points, self.size), known, self.method.finds_feet)
            u, v, distance, converged = (np.asarray(x)[: len(points)] for x in found)
            relative = distance.astype(np.float64) / self.unit.diagonal + rounding
            self.feet.finish(start, u, v, relative)
            if self.weights is not None:
                relative = np.where(self.weights[start : start + len(points)] > 0, relative, 0.0)
            return float(relative.sum()), float(relative.max()), int((~converged).sum())

        self.made += 1
        totals = np.array(list(in_threads(one, self.blocks)))
        return totals[:, 0].sum() / self.counted, totals[:, 1].max(), int(totals[:, 2].sum())

    def _measured(
        self, start: int, points: Points, iterate: Iterate, exact: Any, base: BSplineSurface | None
    ) -> tuple[FootPoints, Measured]:
        """One block on the iterate's surface."""
        count = len(points)
        u, v = self._first_feet(points, base) if base is not None else self.feet.read(start, count)
        none = np.zeros(self.size, np.int32)
        before = FootPoints(
            _padded(u, self.size),
            _padded(v, self.size),
            none.astype(u.dtype),
            none,
            none > 0,
            none[0],
            none[0] > 0,
        )
        iterate = Iterate(iterate.surface, before, iterate.state, iterate.step)
        return _measure(*static_and_numbers(self.method), self._problem(start, points), iterate, exact)

    def _first_feet(self, points: Points, base: BSplineSurface) -> tuple[np.ndarray, np.ndarray]:
        nearest = closest_point(base, _padded(points, self.size))
        return tuple(np.asarray(x, working_dtype())[: len(points)] for x in (nearest.u, nearest.v))  # type: ignore[return-value]

    def _problem(self, start: int, points: Points) -> Problem:
        """A block, padded to the common size by points of weight 0."""
        count = len(points)
        weight = np.zeros(self.size)
        weight[:count] = 1.0 if self.weights is None else self.weights[start : start + count]
        problem = make_problem(_padded(points, self.size), weight, self.unit, self.tolerances, padded=False)
        return eqx.tree_at(lambda p: p.real, problem, np.arange(self.size) < count)


@partial(compiled, kept=True, static_argnums=0)
def _measure(
    rest: Any, numbers: Any, problem: Problem, iterate: Iterate, exact: Array
) -> tuple[FootPoints, Measured]:
    method = eqx.combine(numbers, rest)
    projection, state = method.measure(problem, iterate, exact)
    totals, maximum = problem.totals(projection, iterate.projection)
    return projection, Measured(state.sums, totals, maximum, projection.active, projection.exact)


def _padded(x: np.ndarray, size: int) -> np.ndarray:
    """Filled up to `size` with the last entry."""
    return np.concatenate([x, np.repeat(x[-1:], size - len(x), axis=0)]) if len(x) < size else x


def in_threads(work: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    """`work` on every item, in order, a few at a time.

    The first item goes alone, for it compiles what the others use.
    """
    threads = min(cores(), MOST_THREADS)
    waiting: deque[Future[Any]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for number, item in enumerate(items):
            if number == 0:
                yield work(item)
                continue
            waiting.append(pool.submit(work, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
