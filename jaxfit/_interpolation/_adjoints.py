"""`UnrolledAdjoint` and `ImplicitAdjoint`: derivatives of an iterative interpolation."""

from abc import abstractmethod

import equinox as eqx

# Moves after which feet that are never held count as converged.
CONVERGED_AFTER = 200


class AbstractAdjoint(eqx.Module):
    """How the parameters of feet depend on the data."""

    @abstractmethod
    def moves(self, freeze_after: int | None) -> int | None:
        """Through how many moves of the net feet are followed; None for feet that do not move at all."""


class UnrolledAdjoint(AbstractAdjoint):
    r"""The derivative of the fit as run, which finite differences agree with.

    Feet are followed through the iterations before they are held, each by the implicit derivative of its
    closest point. The net then solves $N(\hat u, \hat v) P = Q$, and so does its derivative

    $$N \, dP = dQ - dN \, P,$$

    with one sparse solve, whatever the number of iterations was.

    Parameters
    ----------
    moves_followed : int, optional
        Through how many moves; default as many as move feet, `freeze_after`, or 200 where feet are never
        held. Reverse mode runs each a second time and keeps one net for each.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(adjoint=jf.UnrolledAdjoint()).adjoint
    UnrolledAdjoint()
    """

    moves_followed: int | None = None

    def moves(self, freeze_after: int | None) -> int:
        """As told, or as many as move feet."""
        if self.moves_followed is not None:
            return self.moves_followed
        return CONVERGED_AFTER if freeze_after is None else freeze_after


class ImplicitAdjoint(AbstractAdjoint):
    r"""The derivative at held parameters and knots, $dP = N(\hat u, \hat v)^{-1} dQ$.

    Any parameters at which the surface meets the data solve the interpolation problem, so this is the
    derivative of a solution, though not of the one that the fit returns for other data. It is linear in the
    data and cheaper than `UnrolledAdjoint`.

    Examples
    --------
    >>> import jaxfit as jf
    >>> jf.GeometricInterpolation(adjoint=jf.ImplicitAdjoint()).adjoint
    ImplicitAdjoint()
    """

    def moves(self, freeze_after: int | None) -> None:
        """None."""
        return
