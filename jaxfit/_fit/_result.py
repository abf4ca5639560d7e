"""What every fit returns."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxfit._checks import is_concrete
from jaxfit._fit._loop import Carry
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._summary import describe, describe_briefly
from jaxfit._splines import BSplineSurface


class History(eqx.Module):
    """What happened in every iteration, the first surface included.

    `average` and `maximum` are errors as fractions of the diagonal: at closest points, or at frozen ones
    while a method holds them. `evaluations` of the surface were made for a foot, and its parameters (u plus
    v) moved by `change`, both on average over the points.

    Of approximations, `active` points pulled in each iteration, and `net` is the number of control points
    along u and v; `faired` and `refined` mark the surfaces that fairing or new knots have just changed. Fits
    of grids have none of these.

    Inside a transformation, where the number of iterations is not known, the arrays have room for more
    and end in NaN.
    """

    average: Float[Array, " steps"]
    maximum: Float[Array, " steps"]
    evaluations: Float[Array, " steps"]
    change: Float[Array, " steps"]
    active: Int[Array, " steps"] | None = None
    net: Int[Array, "steps 2"] | None = None
    faired: Bool[Array, " steps"] | None = None
    refined: Bool[Array, " steps"] | None = None


@jax.tree_util.register_static
class Name(str):
    """A string that is part of a tree's structure, so that results with one go through transformations."""


class Fit(eqx.Module):
    """A fitted surface, and an honest account of how well it fits.

    Attributes
    ----------
    surface : BSplineSurface
    u, v : array (points,), or (n, m) for a grid
        Parameters of the foot point of every data point.
    errors : array (points,), or (n, m) for a grid
        |Q - R(u, v)| of every point, as a fraction of the diagonal of the data's bounding box. Those of an
        interpolation include what rounding the control points may add, but not the rounding of evaluating
        the surface, which far from the origin is about as much again.
    average_error, maximum_error : float arrays ()
        Of `errors`.
    history : History
        Errors, evaluations and parameter changes of every iteration.
    result : item of RESULTS
        Why the fit stopped; `converged` and `message` say it as a boolean and as a sentence.
    stats : dict
        `num_steps`: iterations; `diagonal`: of the data, in its own unit; `unconverged_feet`: points whose
        foot was not found to the tolerance. Of an approximation also `method`, the name of its class. Of an
        interpolation also the `tolerance` in force; other entries
        stand with the methods that add them.
    """

    surface: BSplineSurface
    u: Float[Array, "..."]
    v: Float[Array, "..."]
    errors: Float[Array, "..."]
    average_error: Float[Array, ""]
    maximum_error: Float[Array, ""]
    history: History
    result: Any
    stats: dict[str, Any]

    def __str__(self) -> str:
        return describe(self)

    def __repr__(self) -> str:
        return describe_briefly(self)

    @property
    def converged(self) -> Any:
        """Whether all tolerances are met."""
        return self.result == RESULTS.converged

    @property
    def message(self) -> str:
        """Why the fit stopped, in a sentence."""
        sentences: Any = RESULTS
        return sentences[self.result]


def history_of(carry: Carry, method: Any = None) -> History:
    """The recorded errors, cut to the iterations made where that number is known; `method` is that of an
    approximation.
    """
    records, concrete = carry.next.records, is_concrete(carry)
    columns: list[Any] = [records.average, records.maximum, records.evaluations, records.change]
    if records.active is not None and records.shape is not None:
        columns += [records.active, records.shape.T]
    if concrete:
        # Cut by NumPy: by JAX, every new length would be a new compilation.
        columns = [np.asarray(x)[: int(carry.step) + 1] for x in columns]
    if records.shape is not None:
        columns += _marks(columns[-1], getattr(method, "fairing", None))
    return History(*(jax.device_put(columns) if concrete else columns))


def _marks(net: Any, fairing: Any) -> list[Any]:
    """Which surfaces have just been faired, and which just been refined."""
    xp: Any = np if is_concrete(net) else jnp
    step = np.arange(net.shape[0])
    none = step < 0
    faired = none if fairing is None else (step > 0) & (step % fairing.every == 0)
    before = xp.concatenate([net[:1], net[:-1]])
    return [xp.asarray(faired), xp.any(net > before, axis=1)]


def converged_or_raise(fit: Fit) -> Fit:
    """The fit; raises its sentence if it has not converged.

    Inside transformations whatever depends on the fit raises, when it runs.
    """
    if is_concrete(fit.result):
        if not bool(fit.converged):
            raise RuntimeError(f"the fit did not converge: {fit.message}")
        return fit
    return eqx.error_if(fit, fit.result != RESULTS.converged, "the fit did not converge.")
