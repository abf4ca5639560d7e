"""The text of a printed fit."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from jaxfit._checks import is_concrete
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._remarks import (
    MOST,
    MUCH,
    share_beyond_border,
    share_of_outliers,
    with_border,
    with_outliers,
    with_sides,
    with_start,
)
from jaxfit._quality import Regularity
from jaxfit._splines import BSplineSurface

if TYPE_CHECKING:
    from jaxfit._fit._result import Fit


MANY_HOLES = 20
_REMEDIES = {
    "grid": "look there whether the grid's points are in order, and none repeats its neighbour "
    "(fit.regularity.fold_parameters)",
    "cloud": "smooth it more, loosen the tolerances, or start from a base surface without folds",
    "scan": "smooth it more, loosen the tolerances, or give a boundary of a part that is less bent",
}


def facts(fit: Any) -> dict[str, str]:
    """Names and values for a table: net, order, iterations, errors in per cent, how regular the surface is,
    and why the fit stopped.
    """
    some = ", of the points that count" if left_out(fit) else ""
    return {
        "net": _said_net(fit),
        "order": "{} x {}".format(*fit.surface.order),
        **_tolerance_facts(fit),
        "iterations": _said_iterations(fit),
        "average error": f"{100 * float(fit.average_error):.4g} % of the diagonal{some}",
        "maximum error": f"{100 * float(fit.maximum_error):.4g} % of the diagonal{some}",
        **_cleaning_facts(fit),
        **_trim_facts(fit),
        **_regularity_facts(fit),
        "stopped": fit.message,
    }


def _is_of_cloud(fit: Any) -> bool:
    """Whether it is an approximation, which alone has tolerances for average and maximum."""
    return "tol_average" in fit.stats


def _said_net(fit: Any) -> str:
    return "{} x {}{}".format(*fit.surface.shape, ", more control points than points" * _has_surplus(fit))


def _has_surplus(fit: Any) -> bool:
    """Whether a cloud leaves some of the control points open."""
    nu, nv = fit.surface.shape
    return _is_of_cloud(fit) and nu * nv > _points_that_count(fit)


def _points_that_count(fit: Any) -> int:
    """Those of a weight above 0; all if no iteration has counted them."""
    active = fit.history.active
    return (0 if active is None else int(np.max(active))) or np.size(fit.errors)


def _said_iterations(fit: Any) -> str:
    before = fit.stats.get("growth_steps", 0)
    return f"{int(fit.stats['num_steps'])}{f', after {int(before)} while the net grew' if before else ''}"


def _tolerance_facts(fit: Any) -> dict[str, str]:
    """What the fit aimed at, in per cent: whoever passed per cent as a fraction sees it here."""
    if "tolerance" in fit.stats:  # of an interpolation
        return {"tolerances": f"maximum {100 * float(fit.stats['tolerance']):.4g} %"}
    goals = [fit.stats.get(f"tol_{name}") for name in ("average", "maximum")]
    if any(goal is None for goal in goals):
        return {}
    average, maximum = ("without limit" if np.isinf(x) else f"{100 * float(x):.4g} %" for x in goals)
    return {"tolerances": f"average {average}, maximum {maximum}"}


def _regularity_facts(fit: Any) -> dict[str, str]:
    if not _is_finite(fit):
        return {}
    found: Regularity = fit.regularity
    unit = float(fit.stats.get("diagonal", 1.0))
    # Divided twice, for its square may be less than the least number.
    energy = f"thin plate {found.thin_plate_energy / unit / unit:.4g} squared diagonals"
    if found.curvature_energy is not None:
        energy += f", curvature {found.curvature_energy:.4g}"
    without = {} if not found.degenerate else {"no normal": f"at {found.degenerate:,} of {_samples(found)}"}
    least, largest = found.line_ratios
    return {
        "folds": _said_folds(fit),
        **without,
        "parameter lines": f"at least {np.degrees(found.smallest_angle):.3g} degrees apart, "
        f"ratio {least:.2g} to {largest:.2g}",
        "energies": energy,
    }


_LEFT_OUT = {
    "nodata": "without data",
    "non_finite": "not finite",
    "duplicates": "duplicates",
    "outliers": "outliers",
    "off_the_sheet": "off the sheet",
}


def _cleaning_facts(fit: Any) -> dict[str, str]:
    """How many points were read, and why some were left out."""
    if "points_read" not in fit.stats:
        return {}
    counts = left_out(fit)
    reasons = ", ".join(f"{count:,} {name}" for name, count in counts.items())
    read = int(fit.stats["points_read"])
    said = {"points read": f"{read:,}; left out: {reasons or 'none'}"}
    if np.isfinite(np.asarray(fit.errors)).sum() > read - sum(counts.values()):
        average, maximum = errors_of_all(fit)
        said["all points"] = f"average error {average:.4g} %, maximum {maximum:.4g} %, with those left out"
    return said


def left_out(fit: Any) -> dict[str, int]:
    """How many points do not count, by the reason."""
    counts = {name: int(fit.stats.get(key, 0)) for key, name in _LEFT_OUT.items()}
    return {name: count for name, count in counts.items() if count}


def errors_of_all(fit: Any) -> tuple[float, float]:
    """Average and maximum in per cent of the diagonal, over all points that are finite."""
    errors = 100 * np.asarray(fit.errors, float)
    return float(np.nanmean(errors)), float(np.nanmax(errors))


def _trim_facts(fit: Any) -> dict[str, str]:
    """The loops, and the errors of the points inside them."""
    trimmed = fit.trimmed
    if trimmed is None or not _is_finite(fit):
        return {}
    holes = {0: "no hole", 1: "one hole"}.get(trimmed.holes, f"{trimmed.holes:,} holes")
    if trimmed.holes and "hole_length" in fit.stats:
        advice = "; a larger one closes small gaps" if trimmed.holes > MANY_HOLES else ""
        holes += f" (gaps wider than {float(fit.stats['hole_length']):.4g}, the hole length{advice})"
    inside, errors = np.asarray(fit.inside), 100 * np.asarray(fit.errors, float)
    within = f"{int(inside.sum()):,} of {inside.size:,} points"
    if inside.any():
        kept = errors[inside]
        within += f", average error {kept.mean():.4g} %, maximum {kept.max():.4g} %"
    outer = len(trimmed.loops[0])
    return {"loops": f"the outer one with {outer:,} vertices, {holes}", "inside the loops": within}


def _said_folds(fit: Any) -> str:
    found: Regularity = fit.regularity
    if not found.folds:
        return "none"
    if fit.trimmed is not None:
        return f"{fit.folds or 'none'} inside the loops, {found.folds - fit.folds:,} cut away"
    return f"at {_places(found)}{_largest_group(found)}"


def _samples(found: Regularity) -> str:
    return f"{found.samples[0] * found.samples[1]:,} samples"


def _places(found: Regularity) -> str:
    return f"{found.folds:,} of {found.pairs:,} places"


def _largest_group(found: Regularity) -> str:
    """Where most folds are: the fold in the middle of the largest group."""
    places = found.fold_parameters[found.fold_groups == 0]
    middle = places[np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1))]
    groups = f" in {found.groups:,} groups, most" if found.groups > 1 else ","
    return "{} round u = {:.3g}, v = {:.3g}".format(groups, *middle)


def _moves(fit: Any) -> int:
    """Iterations that have made the surface: with those of the nets before, but of a scan each net begins
    anew.
    """
    before = 0 if fit.trimmed is not None else int(fit.stats.get("growth_steps", 0))
    return int(fit.stats["num_steps"]) + before


def said_reason(fit: Any, sentence: str) -> str:
    """The reason for which a fit stopped, that nothing was fitted if so, and that its surface folds if it
    does, or was kept from folding.
    """
    missed = is_single(fit) and not bool(fit.converged)
    if is_single(fit) and _is_of_cloud(fit) and not missed and not _moves(fit):
        advice = "" if fit.folds else ", which is returned; lower the tolerances for a closer one"
        last = "fit of the last net" if int(fit.stats.get("growth_steps", 0)) else "fit"
        first = "base surface" if fit.trimmed is None else f"smooth surface that the {last} starts from"
        sentence = f"{sentence.removesuffix('.')} by the {first}{advice}."
    if missed and _is_of_cloud(fit) and fit.result == RESULTS.stalled and not fit.stats["tol_average"]:
        sentence = "the errors have stopped falling."
    if why := fit.stats.get("refused"):
        return f"nothing was fitted: {why}"
    beyond = share_beyond_border(fit) if missed else 0.0
    outliers = share_of_outliers(fit) if missed and beyond <= MUCH else 0.0
    if beyond > MUCH:
        sentence = with_border(fit, sentence, beyond)
    if outliers:
        sentence = with_outliers(fit, sentence, outliers)
    if missed and _is_of_cloud(fit):
        sentence = with_start(fit, sentence)
    if is_single(fit) and (far := fit.stats.get("far_sides")):
        sentence = with_sides(sentence, far)
    if missed and beyond <= MOST and not outliers and fit.stats.get("points_out_of_reach", 0) > 0:
        points = _said_points(int(fit.stats["points_out_of_reach"]))
        finer = "" if fit.result == RESULTS.net_exhausted else "insert knots, or "
        sentence = (
            f"{sentence} {points} out of reach of a surface of this net that does not fold; {finer}look "
            "whether they lie on another sheet."
        )
    if is_single(fit) and _has_surplus(fit):
        net, count = np.prod(fit.surface.shape), _points_that_count(fit)
        advice = "" if missed else "; a smaller net will do"
        points = f"{count:,} point{'s' * (count != 1)}"
        sentence = f"{sentence} There are {net:,} control points for {points}{advice}."
    if not (is_single(fit) and _is_finite(fit) and fit.folds):
        return sentence
    where = _places(fit.regularity) if fit.trimmed is None else f"{fit.folds:,} places inside its loops"
    kind = "grid" if not _is_of_cloud(fit) else "cloud" if fit.trimmed is None else "scan"
    other = "; if so, try StandardInterpolation()" if not fit.stats.get("solved", True) else ""
    folds = f"the surface folds at {where}: {_REMEDIES[kind]}{other}."
    if bool(fit.converged):
        return f"{sentence.removesuffix('.')}, but {folds}"
    return f"{sentence} T{folds[1:]}"


def _said_points(count: int) -> str:
    return f"{count:,} points are" if count > 1 else "1 point is"


def _is_finite(fit: Any) -> bool:
    return all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(fit.surface))


def describe(fit: "Fit") -> str:
    """`str(fit)`: its `facts`, one a line; the shapes of its arrays where it is traced or one of a batch."""
    if not is_single(fit):
        return eqx.tree_pformat(fit)
    rows = {"method": str(fit.stats["method"]), **facts(fit)}
    return "\n".join(f"{name:<18}{value}" for name, value in rows.items())


def describe_briefly(fit: "Fit") -> str:
    """`repr(fit)`, on one line."""
    if not is_single(fit):
        return eqx.tree_pformat(fit)
    said = facts(fit)
    errors = ", ".join(f"{which} error {said[f'{which} error']}" for which in ("average", "maximum"))
    net = "{} x {}".format(*fit.surface.shape)
    return f"<Fit: {net} control points, {errors.replace(' of the diagonal,', ',')}; {fit.message}>"


def is_single(fit: "Fit") -> bool:
    if not (isinstance(fit.surface, BSplineSurface) and is_concrete(fit)):
        return False
    numbers = [np.asarray(x) for x in (fit.average_error, fit.maximum_error, fit.stats.get("num_steps"))]
    return all(x.ndim == 0 and x.dtype.kind in "fiu" for x in numbers)
