"""`ImplicitAdjoint` and `UnrolledAdjoint`: what the derivative of a fit is."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from jaxfit._checks import check_number

# Moves after which feet that are never held count as converged.
CONVERGED_AFTER = 200
# In single precision a residual of rounding times what is good in double leaves a per cent of a derivative.
SINGLE, TO_ROUNDING = 1e-10, 1e-2


class AbstractAdjoint(eqx.Module):
    """What the derivative of a fit is."""

    @abstractmethod
    def moves(self, freeze_after: int | None) -> int | None:
        """Of an interpolation: through how many moves of the net feet are followed; None for feet that do
        not move at all.
        """


class UnrolledAdjoint(AbstractAdjoint):
    r"""The derivative of the fit as run, which finite differences agree with.

    Of an approximation: of every iteration, in what the iteration before has left. It is right wherever the
    fit stops, also after `max_steps=5`, and points, weights, numbers of the method, the base surface and
    `start` all have one. The iteration is run so that it can be followed: feet converge in each iteration,
    without the short cuts of `single_step`, and linear systems are solved to rounding, so the surface differs
    a little from that of a fit without a derivative. What is decided (whether a step is accepted, where knots
    are inserted, which lambda is chosen, when the fit ends) counts as constant; where it is about to change,
    one-sided derivatives differ. Where feet move there is no second derivative: differentiating twice raises
    TypeError. At rest `ImplicitAdjoint` is faster, and needs no memory for iterations.

    Of an interpolation: feet are followed through the iterations before they are held, each by the implicit
    derivative of its closest point. The net then solves $N(\hat u, \hat v) P = Q$, and so does its derivative

    $$N \, dP = dQ - dN \, P,$$

    with one sparse solve, whatever the number of iterations was.

    Parameters
    ----------
    moves_followed : int, optional
        Through how many moves; default as many as move feet, `freeze_after`, or 200 where feet are never
        held. Reverse mode runs each a second time and keeps one net for each. Interpolation only; an
        approximation is followed through all its iterations, of which reverse mode runs each three times and
        keeps about `max_steps` / 16 + 16 states with the feet of all points.

    Raises
    ------
    ValueError
        If `moves_followed` is no whole number of at least 0.

    Notes
    -----
    Source: the derivative of equations (13) and (14) of Kineri, Wang, Lin and Maekawa (2012), and of the
    methods of its section 4. Iterations are kept as by A. Griewank, Achieving logarithmic growth of temporal
    and spatial complexity in reverse automatic differentiation, Optim. Methods Softw. 1, 1992, on two
    levels.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(adjoint=jf.UnrolledAdjoint()).adjoint
    UnrolledAdjoint()
    """

    moves_followed: int | None = None

    def __check_init__(self) -> None:
        if self.moves_followed is not None:
            check_number("moves_followed", self.moves_followed, 0, whole=True)

    def moves(self, freeze_after: int | None) -> int:
        """As told, or as many as move feet."""
        if self.moves_followed is not None:
            return self.moves_followed
        return CONVERGED_AFTER if freeze_after is None else freeze_after


class ImplicitAdjoint(AbstractAdjoint):
    r"""The derivative of the surface that a fit comes to rest at, by the implicit function theorem.

    Of an approximation: where G(P) = 0 is the condition of `StationarityCondition`, with the feet eliminated,

    $$dP = -\Big(\frac{\partial G}{\partial P}\Big)^{-1} dG,$$

    by one linear solve, whatever the number of iterations was. A fit stops where its errors no longer fall,
    which is before G vanishes, and the derivative there would be wrong by percents. So the surface is first
    polished: Newton steps on G. The fit that is differentiated, and any fit that `adjoint=ImplicitAdjoint()`
    is passed to, returns the polished surface. Its `stats["stationarity"]` is |G| over the sum of the norms
    of the terms of G. Read it: above 1e-6 the surface could not be polished, and the derivative is not to be
    trusted; differentiating outside `jit` then warns, and above 1e-3 raises an ArithmeticError. Inside `jit`
    the derivative is NaN there.

    A lambda that `GeneralizedCrossValidation` or `Discrepancy` has chosen counts as a constant: differences
    of fits also hold what its choice changes.

    There is no second derivative: differentiating twice raises TypeError.

    Of an interpolation: the derivative at held parameters and knots, $dP = N(\hat u, \hat v)^{-1} dQ$. Any
    parameters at which the surface meets the data solve the interpolation problem, so this is the derivative
    of a solution, though not of the one that the fit returns for other data. It is linear in the data and
    cheaper than `UnrolledAdjoint`.

    Parameters
    ----------
    residual : float
        Polishing ends at this relative residual of G (default 1e-12), or at rounding, as always in single
        precision. Where that is too far from rest, outside `jit`, there is a warning: above 1e-6, in single
        precision above the residual times the ratio of the rounding units (5e-4).
    polish_steps : int
        The largest number of Newton steps (default 100; most fits need less than 20). Where they are rejected
        they are damped. Where the stationarity is more than 0.5 after a tenth of them, and at least 10, they
        end: the surface at rest would be quite another one. 0 leaves the surface as it is. Approximation
        only.

    Raises
    ------
    ValueError
        If a number is out of range.

    Notes
    -----
    Source: the implicit function theorem, as in M. Blondel et al., Efficient and modular implicit
    differentiation, NeurIPS 35 (2022).

    Examples
    --------
    >>> import jaxfit as jf
    >>> adjoint = jf.ImplicitAdjoint()
    >>> adjoint.residual, adjoint.polish_steps
    (1e-12, 100)
    """

    residual: float = 1e-12
    polish_steps: int = 100

    def __check_init__(self) -> None:
        check_number("residual", self.residual, 0.0)
        check_number("polish_steps", self.polish_steps, 0, whole=True)

    def moves(self, freeze_after: int | None) -> None:
        """None."""
        return

    def goal(self, dtype: Any) -> float:
        """The residual to polish to in this precision: where it is single, to rounding."""
        return self.good(dtype) * (1.0 if jnp.finfo(dtype).eps < SINGLE else TO_ROUNDING)

    def good(self, dtype: Any) -> float:
        """The residual that is good enough in this precision."""
        return float(self.residual) * float(jnp.finfo(dtype).eps) / float(jnp.finfo(jnp.float64).eps)
