"""How feet move within a pass over the points: not at all, by one step, or all the way.

The slots of a block of rows are in one line.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._barrier import materialise
from jaxfit._cells import (
    Jet,
    Rows,
    in_line,
    in_rows,
    jet_along_rows,
    values_along_rows,
)
from jaxfit._closest import AbstractFootMethod, Limits, RowBox, arrive, follow, third_derivatives
from jaxfit._splines._pieces import Pieces


class Moved(NamedTuple):
    """Feet, their residuals, which of them are where they belong, and which are in their row's cell."""

    u: Float[Array, " slots"]
    v: Float[Array, " slots"]
    e: Float[Array, "d slots"]
    certain: Bool[Array, " slots"]
    stays: Bool[Array, " slots"]


class AbstractFootMove(eqx.Module):
    """What happens to the feet of a block of rows."""

    looks: AbstractClassVar[int]  # at most so many at a foot, until it is certain

    def prepare(self, problem: Any, pieces: Pieces) -> Any:
        """What every block needs of the points and the surface."""
        del problem, pieces

    @abstractmethod
    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, box: RowBox, target: Any, u: Any, v: Any
    ) -> Moved:
        """Move the feet (u, v) of `target`; `box` is that of the rows' cells."""


class Stay(AbstractFootMove):
    """Feet as they are."""

    looks: ClassVar[int] = 1

    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, box: RowBox, target: Any, u: Any, v: Any
    ) -> Moved:
        """Only the residuals are evaluated."""
        values = _evaluated(values_along_rows, problem, pieces, part, box, u, v)
        sure = jnp.ones(u.shape, bool)
        return Moved(u, v, target - in_line(values), sure, sure)


class Follow(AbstractFootMove):
    """One step of a method, and the residual foreseen there."""

    method: AbstractFootMethod
    tolerance: Float[Array, ""]

    looks: ClassVar[int] = 1

    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, box: RowBox, target: Any, u: Any, v: Any
    ) -> Moved:
        """See `follow`."""
        jet = Jet(*map(in_line, _evaluated(jet_along_rows, problem, pieces, part, box, u, v)))
        moved = follow(self.method, target - jet.value, jet, u, v, box, self.tolerance)
        sure = jnp.ones(u.shape, bool)
        return Moved(*moved, sure, sure)


class Arrive(AbstractFootMove):
    """All the way, in so far as one evaluation proves it; what it does not prove is left to others."""

    tolerance: Float[Array, ""]

    looks: ClassVar[int] = 4

    def prepare(self, problem: Any, pieces: Pieces) -> tuple[Float[Array, " cells"], Float[Array, ""]]:
        """Bounds on the third derivatives, and a tolerance that can be reached."""
        return third_derivatives(pieces), Limits.of(self.tolerance, problem.diagonal, 0).tolerance

    def __call__(
        self, problem: Any, pieces: Pieces, ready: Any, part: Rows, box: RowBox, target: Any, u: Any, v: Any
    ) -> Moved:
        """See `arrive`."""
        jet = Jet(*map(in_line, _evaluated(jet_along_rows, problem, pieces, part, box, u, v)))
        (bounds, tolerance), creased = ready, pieces.axis_u.creased or pieces.axis_v.creased
        return Moved(
            *arrive(target - jet.value, jet, u, v, box, bounds[part.cell][:, None], tolerance, creased)
        )


def _evaluated(
    evaluate: Callable[..., Any], problem: Any, pieces: Pieces, part: Rows, box: RowBox, u: Array, v: Array
) -> Any:
    """What `evaluate` makes of the rows' polynomials at the feet, in rows, each of its results once."""

    u, v = (in_rows(x, part.cell.shape[0]) for x in (u, v))
    always = problem.diagonal > 0
    s, t = materialise(always, lambda u, v: box.along_rows().local(u, v), u, v)
    return materialise(always, evaluate, pieces.coefficients[part.cell], s, t)
