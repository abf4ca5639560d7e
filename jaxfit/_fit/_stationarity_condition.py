"""`StationarityCondition`: what a method says about the surfaces that it comes to rest at."""

from typing import Any

import equinox as eqx
from jaxtyping import Bool, Float

from jaxfit._normal_equations import AbstractPenalty


class StationarityCondition(eqx.Module):
    r"""The condition that a method's final surface meets, from which the derivative of its fits follows.

    With the foot $(u_k, v_k)$ and the residual $r_k = R(u_k, v_k) - Q_k$ of every point, for every control
    point that is not held

    $$\sum_k w_k N_i(u_k) N_j(v_k)\, r_k + \tfrac{1}{2} \frac{\partial S}{\partial P_{ij}} = 0.$$

    Attributes
    ----------
    weight : array (points,)
        w_k: the weights of the points, times the derivative of a loss.
    held : array (nu, nv) of bool
        Control points that stay where the base surface has them.
    penalty : AbstractPenalty, optional
        S, the smoothing term, a quadratic form; its own coefficients may depend on the surface.

    Notes
    -----
    Source: the gradient of the sum of squared distances, with the smoothing term of equation (10) of Kineri,
    Wang, Lin and Maekawa (2012). Moving feet add nothing to it, for their residuals are orthogonal.

    Examples
    --------
    >>> at_rest = jf.StationarityCondition(weight=np.ones(5), held=np.zeros((4, 4), bool))
    >>> at_rest.penalty is None
    True
    """

    weight: Float[Any, " points"]
    held: Bool[Any, "nu nv"]
    penalty: AbstractPenalty | None = None
