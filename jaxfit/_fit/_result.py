"""`Fit`, the result of every fit."""

from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxfit._checks import is_concrete
from jaxfit._fit._history import History
from jaxfit._fit._reasons import RESULTS, result_of
from jaxfit._fit._summary import describe, describe_briefly, said_reason
from jaxfit._quality import Regularity, regularity
from jaxfit._splines import BSplineSurface
from jaxfit._trimmed import TrimmedSurface

MUCH_MOVED = 0.05  # of the diagonal: grids that were measured are less asymmetric


@jax.tree_util.register_static
class Name(str):
    """A string that is part of a tree's structure, so that results with one go through transformations."""


class Fit(eqx.Module):
    """A fitted surface, its errors, and the reason for which the fit stopped.

    Attributes
    ----------
    surface : BSplineSurface
    u, v : array (points,), or (n, m) for a grid
        Parameters of the foot point of every data point. With `errors` in single precision from
        `approximate_stream`, which gives NumPy arrays.
    errors : array (points,), or (n, m) for a grid
        |Q - R(u, v)| of every point, as a fraction of the diagonal of the data's bounding box. They include a
        bound on the rounding of the control points (of clouds, outside transformations). They do not include
        the rounding of evaluating the surface, which is about as large far from the origin.
    average_error, maximum_error : float arrays ()
        Of `errors`.
    history : History
        Of every iteration: `average`, `maximum`, evaluations and parameter changes.
    result : item of RESULTS
        Why the fit stopped; `converged` and `message` give it as a boolean and as a sentence. A fit may meet
        its tolerances with a surface that folds; the sentence then says so.
    regularity : Regularity
        Number and places of folds, parameter lines and energies of the surface, measured on first use.
        `folds` is their number, inside the loops where the surface is trimmed.
    stats : dict
        `num_steps`: iterations; `diagonal`: of the data, in its own unit; `unconverged_feet`: points whose
        foot was not found to the tolerance; `method`, the name of its class. Of an approximation also
        `tol_average` and `tol_maximum`, infinite where none was given, and `loss`, the name of the class of
        the method's loss, if it has one. Of an interpolation also the
        `tolerance` in force, and of one with symmetry `asymmetry`: the largest
        distance between a data point and the mirror image of its partner, as a fraction of the diagonal.
        Methods add further entries, which their docstrings describe.
    trimmed : TrimmedSurface or None
        The surface cut to the sheet of the points, where the fit has found its rim and holes; `surface` is
        larger. `inside` says which points lie within.

    Examples
    --------
    The shapes of a fit, found without computing it:

    >>> grid = np.zeros((6, 5, 3))
    >>> fit = jax.eval_shape(lambda grid: jf.interpolate(grid, jf.StandardInterpolation()), grid)
    >>> fit.surface.control_points.shape, fit.errors.shape, fit.average_error.shape
    ((6, 5, 3), (6, 5), ())
    """

    surface: BSplineSurface
    u: Float[Any, "..."]
    v: Float[Any, "..."]
    errors: Float[Any, "..."]
    average_error: Float[Array, ""]
    maximum_error: Float[Array, ""]
    history: History
    result: Any
    stats: dict[str, Any]
    trimmed: TrimmedSurface | None = None

    def __str__(self) -> str:
        return describe(self)

    def __repr__(self) -> str:
        return describe_briefly(self)

    @property
    def converged(self) -> Any:
        """Whether all tolerances are met."""
        return self.result == RESULTS.converged

    @property
    def inside(self) -> Bool[Array, "..."]:
        """Which points have their foot inside the loops of `trimmed`: all, where there are none.

        Points that were left out as no part of the sheet are not inside.
        """
        if self.trimmed is None:
            return jnp.ones(jnp.shape(self.errors), bool)
        return self.trimmed.contains(self.u, self.v) & jnp.asarray(self.stats.get("counted", True))

    @cached_property
    def regularity(self) -> Regularity:
        """Folds, parameter lines and energies of the surface; see `jaxfit.regularity`.

        Measured on the host when it is first asked for, and kept. Raises TypeError while the fit is traced
        and ValueError for a batch, of which `jax.tree.map(lambda x: x[i], fit)` is a fit.
        """
        return regularity(self.surface)

    @property
    def folds(self) -> int:
        """The folds that `regularity` finds: inside the loops of `trimmed`, or where there are none, all."""
        places = self.regularity.fold_parameters
        if self.trimmed is None or not len(places):
            return len(places)
        return int(np.asarray(self.trimmed.contains(*places.T)).sum())

    @property
    def message(self) -> str:
        """Why the fit stopped; that its surface folds or is the base surface, if so; and what the errors of a
        symmetrised grid refer to.

        Folds are those of `regularity`; a fit that is traced or one of a batch does not tell.
        """
        sentences: Any = RESULTS
        sentence = said_reason(self, sentences[self.result])
        moved = 0.5 * self.stats.get("asymmetry", 0.0)
        if is_concrete(moved) and np.ndim(moved) == 0 and moved > self.stats.get("tolerance", np.inf):
            wrong = "; look whether it is mirrored along the other axis" if moved > MUCH_MOVED else ""
            return (
                f"{sentence} Errors are measured to the symmetrised grid, whose points lie up to "
                f"{100 * float(moved):.2g} % of the diagonal away from the given ones{wrong}."
            )
        return sentence


def converged_or_raise(fit: Fit) -> Fit:
    """The fit; raises its sentence if it has not converged.

    Inside transformations whatever depends on the fit raises, when it runs.
    """
    if is_concrete(fit.result):
        if not bool(fit.converged):
            raise RuntimeError(f"the fit did not converge: {fit.message}")
        return fit
    reasons: Any = RESULTS
    sentences = [f"the fit did not converge: {reasons[result_of(x)]}" for x in range(len(reasons))]
    return eqx.branched_error_if(fit, fit.result != RESULTS.converged, fit.result._value, sentences)
