"""`regularity`: folds, parameter lines and energies of a surface."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxfit._checks import check_finite, check_kind, check_number, is_concrete
from jaxfit._quality._energies import energies
from jaxfit._quality._folds import TangentPlanes, find_folds, group_folds, tangent_planes
from jaxfit._quality._host_derivatives import HostDerivatives, UnitSurface
from jaxfit._splines import BSplineSurface

SAMPLES = 200  # along each direction, and
SAMPLES_A_SPAN = 5  # at least: with fewer, sharp bends of fine nets count as folds, and some folds do not


class Regularity(eqx.Module):
    r"""Whether a surface is one that one would keep: what `regularity` returns.

    Attributes
    ----------
    folds : int
        Pairs of neighbouring samples, along u and along v, whose normals are more than 90 degrees apart. A
        crease that is as sharp counts as well.
    samples : (int, int)
        Samples along u and along v, evenly spaced, with both ends of the domain.
    degenerate : int
        Samples where the surface has no normal beyond the rounding of its control points, as along a side
        that is drawn together in a point. They are passed over: the samples on both sides of them are
        compared.
    fold_parameters : array (folds, 2)
        Where the folds are, halfway between the two samples: u and v.
    fold_points : array (folds, d)
        The same in space: halfway between the points of the two samples.
    fold_groups : array (folds,)
        The number of the connected patch of samples that each fold belongs to; patch 0 has the most folds.
    smallest_angle : float
        The smallest angle between the parameter lines at any sample, from 0 to pi/2, in radians. Samples
        where $R_u$ or $R_v$ vanishes do not count; 0 if it does everywhere.
    line_ratios : (float, float)
        The least and the largest $|R_u| / |R_v|$ of the same samples, divided by their median, so that
        neither the shape of the patch nor the scale of its parameters matters: both are 1 for evenly spaced
        lines.
    thin_plate_energy : float
        $\int |R_{uu}|^2 + 2 |R_{uv}|^2 + |R_{vv}|^2 \, du\, dv$ with the domain taken to the unit square,
        equation (10) of the paper, in the squared unit of the surface. Exact.
    curvature_energy : float or None
        $\int \kappa_1^2 + \kappa_2^2 \, dA$, equation (9), see `curvature_energy`: without unit. At a fold
        the integral has no finite value, and what Gauss's rule makes of it is large and says no more. None
        where the surface is not in space.

    Examples
    --------
    A sheet that runs back over itself along u:

    >>> u, v = np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 1, 8), indexing="ij")
    >>> knots = jf.clamped_uniform_knots(8, 4)
    >>> sheet = jf.BSplineSurface(np.stack([np.sin(4 * u), v, 0 * u], axis=2), knots, knots)
    >>> found = jf.regularity(sheet)
    >>> found.folds, found.groups, found.fold_parameters.shape
    (200, 1, (200, 2))
    """

    folds: int
    samples: tuple[int, int] = eqx.field(static=True)
    degenerate: int
    fold_parameters: Float[np.ndarray, "folds 2"]
    fold_points: Float[np.ndarray, "folds d"]
    fold_groups: Int[np.ndarray, " folds"]
    smallest_angle: float
    line_ratios: tuple[float, float]
    thin_plate_energy: float
    curvature_energy: float | None

    @property
    def pairs(self) -> int:
        """How many pairs of neighbouring samples there are: 79,600 of 200 x 200."""
        a, b = self.samples
        return (a - 1) * b + a * (b - 1)

    @property
    def groups(self) -> int:
        """Number of connected patches of folds."""
        return int(self.fold_groups.max()) + 1 if self.folds else 0


def regularity(surface: BSplineSurface, samples: int | None = None) -> Regularity:
    r"""Measure folds, parameter lines and bending energies of a surface.

    Errors alone do not show whether a surface can be used: one that passes close to all points may fold over
    between them. Two neighbouring samples with unit normals $n, n'$ are a fold where $n \cdot n' < 0$. In the
    plane that is a change of sign of the Jacobian, and in any dimension a negative inner product of the two
    tangent planes, $(R_u \wedge R_v) \cdot (R'_u \wedge R'_v) < 0$. A surface in one dimension has no tangent
    planes, and all of its samples are degenerate.

    Parameters
    ----------
    surface : BSplineSurface
        In any dimension.
    samples : int, optional
        Samples along each direction, at least 2. Default: 200, or five for each knot span in a direction that
        has more than 40 of them. Folds narrower than the distance between samples may be missed, and a sharp
        bend of a regular surface counts where it takes less than that distance.

    Returns
    -------
    Regularity

    Raises
    ------
    TypeError
        If the surface is traced: all is measured on the host, at once, and not differentiable.
    ValueError
        If `samples` is out of range, or the surface is one of a batch or not finite.

    Notes
    -----
    Source: the definition above is this library's own; energies are those of `curvature_energy` and equation
    (10) of Kineri, Wang, Lin and Maekawa (2012).

    Nothing compiles. With 42 x 42 control points it takes about 20 ms, with 200 x 200 some 400 ms.

    Examples
    --------
    >>> x, y = np.meshgrid([0.0, 1.0], [0.0, 2.0], indexing="ij")
    >>> knots = np.array([0.0, 0.0, 1.0, 1.0])
    >>> rectangle = jf.BSplineSurface(np.stack([x, y, 0 * x], axis=2), knots, knots)
    >>> found = jf.regularity(rectangle)
    >>> found.folds, found.pairs, found.line_ratios, round(found.smallest_angle, 6)
    (0, 79600, (1.0, 1.0), 1.570796)
    """
    _check(surface, samples)
    unit = UnitSurface(surface)
    spans = [len(breaks) - 1 for breaks in unit.breaks]
    counts = [max(SAMPLES, SAMPLES_A_SPAN * n) if samples is None else int(samples) for n in spans]
    u, v = (np.linspace(0.0, 1.0, count) for count in counts)
    derivatives = unit.at(u, v)
    planes = tangent_planes(derivatives)
    here, there = find_folds(planes)
    angle, ratios = _parameter_lines(planes)
    plate, curvature = energies(unit)
    return Regularity(
        folds=len(here),
        samples=(len(u), len(v)),
        degenerate=int(np.sum(~planes.regular)),
        fold_parameters=unit.parameters(_between(np.stack(np.meshgrid(u, v, indexing="ij")), here, there)),
        fold_points=_fold_points(unit, derivatives, here, there),
        fold_groups=group_folds((len(u), len(v)), here, there),
        smallest_angle=angle,
        line_ratios=ratios,
        thin_plate_energy=plate,
        curvature_energy=curvature,
    )


def _fold_points(
    unit: UnitSurface, derivatives: HostDerivatives, here: np.ndarray, there: np.ndarray
) -> Float[np.ndarray, "folds d"]:
    """Points of the surface itself; most surfaces have none to evaluate."""
    if not len(here):
        return np.zeros((0, len(unit.net)))
    return unit.centre + unit.scale * _between(derivatives(0, 0), here, there)


def _between(
    values: Float[np.ndarray, "d a b"], here: np.ndarray, there: np.ndarray
) -> Float[np.ndarray, "folds d"]:
    """Means of the values at both samples of each pair."""
    return 0.5 * (values[:, *here.T] + values[:, *there.T]).T


def _parameter_lines(planes: TangentPlanes) -> tuple[float, tuple[float, float]]:
    """The smallest angle, and the extremes of the ratio against its median."""
    if not planes.crossed.any():
        return 0.0, (1.0, 1.0)
    ratio = planes.ratio[planes.crossed]
    middle = float(np.median(ratio))
    return float(planes.angle[planes.crossed].min()), (
        float(ratio.min()) / middle,
        float(ratio.max()) / middle,
    )


def _check(surface: BSplineSurface, samples: int | None) -> None:
    check_kind("surface", surface, BSplineSurface, "fit.surface")
    if not is_concrete(surface):
        raise TypeError(
            "surface must have values to be measured, but is traced; measure it outside of jit and vmap."
        )
    if np.ndim(surface.control_points) != 3:
        raise ValueError(
            "surface must be a single one, but is a batch of them; take one of them out with jax.tree.map."
        )
    for name in ("control_points", "knots_u", "knots_v"):
        check_finite(name, getattr(surface, name))
    if samples is not None:
        check_number("samples", samples, 2, whole=True)
