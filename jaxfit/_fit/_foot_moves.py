"""How feet move within a pass over the points: not at all, by one step, or all the way.

The slots of a block of rows are in one line.
"""

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._cells import (
    Jet,
    Rows,
    evaluate_values,
    in_line,
    in_rows,
    jet_in_line,
    local_coordinates,
    row_coefficients,
    staged,
)
from jaxfit._closest import AbstractFootMethod, Box, Limits, arrive, box_of, follow, third_derivatives
from jaxfit._splines._pieces import Pieces


class Moved(NamedTuple):
    """Feet, their residuals, and which of them are where they belong."""

    u: Float[Array, " slots"]
    v: Float[Array, " slots"]
    e: Float[Array, "d slots"]
    certain: Bool[Array, " slots"]


class AbstractFootMove(eqx.Module):
    """What happens to the feet of a block of rows."""

    looks: AbstractClassVar[int]  # at most so many at a foot, until it is certain

    def prepare(self, problem: Any, pieces: Pieces) -> Any:
        """What every block needs of the points and the surface."""
        del problem, pieces

    @abstractmethod
    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, target: Any, u: Any, v: Any
    ) -> Moved:
        """Move the feet (u, v) of `target`."""


class Stay(AbstractFootMove):
    """Feet as they are."""

    looks: ClassVar[int] = 1

    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, target: Any, u: Any, v: Any
    ) -> Moved:
        """Only the residuals are evaluated."""
        s, t = (in_rows(x, part.cell.shape[0]) for x in _local(pieces, part, u, v))
        values = staged(problem.diagonal > 0, evaluate_values, row_coefficients(pieces, part), s, t)
        return Moved(u, v, target - in_line(values), jnp.ones(u.shape, bool))


class Follow(AbstractFootMove):
    """One step of a method, and the residual foreseen there."""

    method: AbstractFootMethod

    looks: ClassVar[int] = 1

    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, target: Any, u: Any, v: Any
    ) -> Moved:
        """See `follow`."""
        jet, box = _surroundings(problem, pieces, part, u, v)
        tolerance = problem.foot_tolerance * problem.diagonal
        moved = follow(self.method, target - jet.value, jet, u, v, box, tolerance)
        return Moved(*moved, jnp.ones(u.shape, bool))


class Arrive(AbstractFootMove):
    """All the way, in so far as one evaluation proves it; what it does not prove is left to others."""

    looks: ClassVar[int] = 4

    def prepare(self, problem: Any, pieces: Pieces) -> tuple[Float[Array, " cells"], Float[Array, ""]]:
        """Bounds on the third derivatives, and a tolerance that can be reached."""
        wanted = problem.foot_tolerance * problem.diagonal
        return third_derivatives(pieces), Limits.of(wanted, problem.diagonal, 0).tolerance

    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, target: Any, u: Any, v: Any
    ) -> Moved:
        """See `arrive`."""
        jet, box = _surroundings(problem, pieces, part, u, v)
        (bounds, tolerance), creased = ready, pieces.axis_u.creased or pieces.axis_v.creased
        return Moved(
            *arrive(target - jet.value, jet, u, v, box, bounds[part.cell][:, None], tolerance, creased)
        )


def _surroundings(problem: Any, pieces: Pieces, part: Rows, u: Array, v: Array) -> tuple[Jet, Box]:
    """Derivatives at the feet, and the bounds of their cells."""
    s, t = _local(pieces, part, u, v)
    jet = jet_in_line(problem.diagonal > 0, row_coefficients(pieces, part), s, t)
    ends = [x for axis in (pieces.axis_u, pieces.axis_v) for x in (axis.breaks[0], axis.breaks[-1])]
    return jet, box_of(pieces, part.cell, ends)


def _local(pieces: Pieces, part: Rows, u: Array, v: Array) -> tuple[Array, Array]:
    rows = part.cell.shape[0]
    s, t = local_coordinates(pieces, part.cell[:, None], in_rows(u, rows), in_rows(v, rows))
    return in_line(s), in_line(t)
