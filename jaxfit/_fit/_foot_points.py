"""`FootPoints`: the feet of all points on a surface, and the errors there."""

from typing import Any

import equinox as eqx
from jaxtyping import Bool, Float, Int


class FootPoints(eqx.Module):
    """Foot points of all points on a surface, and the errors there.

    Attributes
    ----------
    u, v : array (points,)
        Parameters of the foot points.
    error : array (points,)
        |Q - R(u, v)|, in the unit of the problem.
    evaluations : array (points,) of int
        Evaluations of the surface spent on each point.
    converged : array (points,) of bool
        Whether the foot was found to the tolerance.
    active : array () of int
        The number of points that influence the next move.
    exact : array () of bool
        False where errors are predictions. Before it stops the loop measures once more, exactly.
    summary : array (4,)
        Filled in by the loop: average and maximum error as fractions of the diagonal, evaluations of the
        surface for each foot, and change of its parameters u plus v, both on average. Points of weight 0 are
        left out.

    Examples
    --------
    >>> u, none = jnp.array([0.25, 0.5]), jnp.zeros(2, jnp.int32)
    >>> projection = jf.FootPoints(u, u, jnp.zeros(2), none, none == 0, jnp.asarray(2), jnp.asarray(True))
    >>> projection.u.shape, int(projection.active), bool(projection.converged.all())
    ((2,), 2, True)
    """

    u: Float[Any, " points"]
    v: Float[Any, " points"]
    error: Float[Any, " points"]
    evaluations: Int[Any, " points"]
    converged: Bool[Any, " points"]
    active: Int[Any, ""]
    exact: Bool[Any, ""]
    summary: Float[Any, "4"] | None = None
