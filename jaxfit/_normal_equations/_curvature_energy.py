r"""The true thin-plate energy, equation (9) of the paper, measured on a surface.

$$\int \kappa_1^2 + \kappa_2^2 \; dA = \int (4 H^2 - 2 K)\, |R_u \times R_v| \, du\, dv$$

It does not depend on the parametrisation, nor on the size of the surface, and is what (10) stands for.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._cells import evaluate_jet
from jaxfit._splines import BSplineSurface
from jaxfit._splines._pieces import make_pieces


def curvature_energy(surface: BSplineSurface, points: int = 6) -> Float[Array, ""]:
    r"""$\int \kappa_1^2 + \kappa_2^2 \, dA$ over a surface in space, by Gauss's rule in every cell.

    Parameters
    ----------
    surface : BSplineSurface
        In three dimensions.
    points : int
        Gauss points in each cell and direction. The integrand is no polynomial, so this is an
        approximation; where the surface is regular it converges fast.

    Returns
    -------
    array ()
        Without unit: 8 pi for a whole sphere of any radius, 0 for a plane. Differentiable.

    Raises
    ------
    ValueError
        If the surface is not in three dimensions.

    Notes
    -----
    Equation (9) of Kineri, Wang, Lin and Maekawa (2012). Points where the surface has no normal count as 0.

    Examples
    --------
    >>> x, y = np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij")
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> square = jf.BSplineSurface(np.stack([x, y, 0 * x], axis=2), knots, knots)
    >>> float(jf.curvature_energy(square))
    0.0
    """
    if surface.dimension != 3:
        raise ValueError(
            f"surface must have 3 coordinates to have curvatures, but has {surface.dimension}; pass a "
            "surface in space."
        )
    net = jnp.asarray(surface.control_points)
    pieces = make_pieces(net, surface.knots_u, surface.knots_v)
    nodes, weights = np.polynomial.legendre.leggauss(points)
    s, t = (jnp.asarray(x.reshape(-1), net.dtype) for x in np.meshgrid(nodes, nodes, indexing="ij"))
    s, t = (jnp.broadcast_to(x, (pieces.cells, x.size)) for x in (s, t))
    weight = jnp.asarray(np.outer(weights, weights).reshape(-1), net.dtype)
    density = curvature_density(*evaluate_jet(jnp.asarray(pieces.coefficients), s, t)[1:])
    # The integrand needs no parameters: in local coordinates every cell is [-1, 1]^2. Empty ones are skipped.
    width_u, width_v = (jnp.diff(jnp.asarray(x.breaks)) > 0 for x in (pieces.axis_u, pieces.axis_v))
    taken = (width_u[:, None] & width_v[None, :]).reshape(-1)
    return jnp.sum(jnp.where(taken[:, None], density * weight[None], 0.0))


def curvature_density(s: Any, t: Any, ss: Any, st: Any, tt: Any) -> Any:
    """(4 H^2 - 2 K) times the element of area, from the derivatives (3, ...), NumPy's or JAX's."""
    xp: Any = np if isinstance(s, np.ndarray) else jnp
    e, f, g = (xp.sum(a * b, axis=0) for a, b in ((s, s), (s, t), (t, t)))
    normal = xp.cross(s, t, axis=0)
    area = xp.sum(normal**2, axis=0)  # the square of the element of area, e g - f^2
    regular = area > 0
    area = xp.where(regular, area, 1.0)
    ll, m, n = (xp.sum(x * normal, axis=0) for x in (ss, st, tt))  # times the root of `area`
    mean = (e * n - 2.0 * f * m + g * ll) / area  # 2 H, likewise
    gauss = (ll * n - m**2) / area
    return xp.where(regular, (mean**2 - 2.0 * gauss) / xp.sqrt(area), 0.0)
