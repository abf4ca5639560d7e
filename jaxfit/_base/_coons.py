"""Bilinear Coons blend of boundary control points (paper equations (6)-(7))."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit._base._boundary import CORNERS, JOINABLE, corner_gaps, diagonal
from jaxfit._checks import check_kind, is_concrete
from jaxfit._compile import compiled
from jaxfit._splines import BSplineCurve, BSplineSurface, greville_abscissae


class AbstractAbscissae(eqx.Module):
    """Where on [0, 1] each row of control points is taken to sit when borders are blended."""

    @abstractmethod
    def __call__(self, knots: Float[Array, " knots"], order: int) -> Float[Array, " n"]:
        """Abscissae of the control points on these knots, from 0 to 1."""


class Greville(AbstractAbscissae):
    r"""Greville abscissae: the blend of four straight sides is their bilinear patch, always.

    $s_i = (t_{i+1} + \dots + t_{i+K-1}) / (K - 1)$, mapped to [0, 1]. The default of `coons_surface`.
    Source: C. de Boor, A Practical Guide to Splines, revised edition (2001), chapter IX.

    Examples
    --------
    >>> [round(float(x), 3) for x in jf.Greville()(jf.clamped_uniform_knots(5, 4), 4)]
    [0.0, 0.167, 0.5, 0.833, 1.0]
    """

    def __call__(self, knots: Float[Array, " knots"], order: int) -> Float[Array, " n"]:
        """Means of order - 1 consecutive knots, mapped to [0, 1]."""
        places = greville_abscissae(knots, order)
        return (places - places[0]) / (places[-1] - places[0])


class Uniform(AbstractAbscissae):
    """Equal steps i/n, whatever the knots, as in equations (6)-(7) of the paper.

    Exact only far inside of uniform knots; elsewhere `Greville` is.

    Examples
    --------
    >>> [round(float(x), 3) for x in jf.Uniform()(jf.clamped_uniform_knots(5, 4), 4)]
    [0.0, 0.25, 0.5, 0.75, 1.0]
    """

    def __call__(self, knots: Float[Array, " knots"], order: int) -> Float[Array, " n"]:
        """Equal steps."""
        return jnp.linspace(0.0, 1.0, knots.shape[0] - order, dtype=knots.dtype)


GREVILLE = Greville()


def coons_surface(
    v0: Any,
    v1: Any,
    u0: Any,
    u1: Any,
    abscissae: Any = GREVILLE,
) -> BSplineSurface:
    r"""The Coons surface of four B-spline curves, opposite ones on equal knots.

    The control points of the curves are blended (paper, equations (6)-(7)). With abscissae
    $s_i, t_j$ and corner points $P_{00}, P_{n0}, P_{0m}, P_{nm}$

    $$P_{ij} = (1-s_i) P_{0j} + s_i P_{nj} + (1-t_j) P_{i0} + t_j P_{im}
      - [(1-s_i)(1-t_j) P_{00} + (1-s_i) t_j P_{0m} + s_i (1-t_j) P_{n0} + s_i t_j P_{nm}].$$

    The surface has the four curves as its sides where they share their corners; where they do not
    quite, `v0` and `v1` win. Works under `jit`, `vmap` and `grad`.

    Parameters
    ----------
    v0, v1 : BSplineCurve
        Along u, at v = 0 and v = 1; n control points in d dimensions, on equal knots.
    u0, u1 : BSplineCurve
        Along v, at u = 0 and u = 1; m control points.
    abscissae : Greville() or Uniform()
        Where control points are taken to sit: at their Greville abscissae (default), so that four
        straight sides give the bilinear patch itself, or at the paper's i/n.

    Raises
    ------
    ValueError
        If two opposite curves have different knots, curves lie in different spaces, or their ends are farther
        apart than 1 % of the diagonal. Values are compared only outside `jit`.
    TypeError
        If one is no curve.

    Examples
    --------
    >>> def line(a, b):
    ...     return jf.BSplineCurve(np.array([a, b]), np.array([0.0, 0, 1, 1]))
    >>> o, x, y, z = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 1.0]
    >>> surface = jf.coons_surface(line(o, x), line(y, z), line(o, y), line(x, z))
    >>> surface(0.5, 0.5).tolist()
    [0.5, 0.5, 0.25]
    """
    check_kind("abscissae", abscissae, AbstractAbscissae, "Greville() or Uniform()")
    _check_curves({"v0": v0, "v1": v1, "u0": u0, "u1": u1})
    for (name_a, a), (name_b, b) in ((("v0", v0), ("v1", v1)), (("u0", u0), ("u1", u1))):
        same = a.knots.shape == b.knots.shape and a.order == b.order
        if same and is_concrete(a.knots, b.knots):
            same = np.array_equal(a.knots, b.knots)
        if not same:
            raise ValueError(
                f"{name_a} and {name_b} must have the same knots, but have not; refine each by "
                "the knots it lacks (merge_knots, insert_knots)."
            )
    controls = tuple(curve.control_points for curve in (v0, v1, u0, u1))
    return BSplineSurface(coons_net(controls, v0.knots, u0.knots, abscissae), v0.knots, u0.knots)


def _check_curves(curves: dict[str, Any]) -> None:
    """That these are curves in one space, whose ends meet as far as they are known."""
    for name, curve in curves.items():
        check_kind(name, curve, BSplineCurve, "BSplineCurve(control_points, knots)")
        d, first = curve.control_points.shape[1], curves["v0"].control_points.shape[1]
        if d != first:
            raise ValueError(f"{name} lies in {d} dimensions and v0 in {first}; give four curves in one.")
    if not is_concrete(curves):
        return
    ends = {name: np.asarray(curve.control_points)[[0, -1]] for name, curve in curves.items()}
    gaps, size = corner_gaps(ends), diagonal(*(np.asarray(x.control_points) for x in curves.values()))
    worst = int(np.argmax(gaps))
    if gaps[worst] > JOINABLE * size:
        v, _, u, _ = CORNERS[worst]
        raise ValueError(
            f"{v} and {u} must share a corner, but their ends are {gaps[worst]:.3g} apart "
            f"({100 * gaps[worst] / size:.3g} % of the diagonal); give curves that meet."
        )


@compiled
def coons_net(
    controls: tuple[Array, Array, Array, Array],
    knots_u: Array,
    knots_v: Array,
    abscissae: AbstractAbscissae,
) -> Array:
    """Control net (nu, nv, d) from those of v0, v1 (nu, d) and u0, u1 (nv, d)."""
    v0, v1, u0, u1 = controls
    s = abscissae(knots_u, knots_u.shape[0] - len(v0))[:, None, None]
    t = abscissae(knots_v, knots_v.shape[0] - len(u0))[None, :, None]
    along_v = (1 - s) * u0[None] + s * u1[None]
    along_u = (1 - t) * v0[:, None] + t * v1[:, None]
    c00, c10, c01, c11 = (x[None, None] for x in (v0[0], v0[-1], v1[0], v1[-1]))
    corners = (1 - s) * ((1 - t) * c00 + t * c01) + s * ((1 - t) * c10 + t * c11)
    net = along_v + along_u - corners
    # The sides exactly: the sum above returns them only to rounding.
    net = net.at[0].set(u0).at[-1].set(u1)
    return net.at[:, 0].set(v0).at[:, -1].set(v1)
