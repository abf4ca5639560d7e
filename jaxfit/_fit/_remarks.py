"""Sentences that a fit's reason is followed by: on points beyond the border, outliers, the surface that it
started from, and sides far away.
"""

from typing import Any

import numpy as np

from jaxfit._fit._reasons import RESULTS

MUCH, MOST = 0.05, 0.5  # shares of the sum of errors
# Outliers: the errors of FEW points make MOST of the sum, the largest is EXTREME times the median, and that
# is at most NEAR times the tolerance.
FEW, EXTREME, NEAR = 0.05, 30.0, 2.0
NEARER = 0.95  # of an average error, where it is worth saying


def share_beyond_border(fit: Any) -> float:
    """What points beyond the border add to the sum of all errors; 0 for a scan, which ends at its loops."""
    return 0.0 if fit.trimmed is not None else float(fit.stats.get("errors_beyond_border", 0.0))


def with_border(fit: Any, sentence: str, share: float) -> str:
    """The reason, and that points lie beyond the border."""
    if share > MOST and fit.result == RESULTS.noise_reached:  # that is not noise
        sentence = "finer nets bring the surface no nearer to the points."
    if share > MOST:
        sentence = _without_advice(fit, sentence)
    count, points = int(fit.stats["points_beyond_border"]), np.size(fit.errors)
    return (
        f"{sentence} {share:.0%} of all errors are those of {count:,} of {points:,} points beyond the border "
        "of the surface, so this is not where they end; give the boundary of all points, or if the method "
        "holds the border, free it by border=FreeBorder()."
    )


def _without_advice(fit: Any, sentence: str) -> str:
    """The reason without another net or other tolerances, where these are of no use."""
    if fit.result in (RESULTS.stalled, RESULTS.net_exhausted, RESULTS.noise_reached):
        return f"{sentence.partition(';')[0].removesuffix('.')}."
    return sentence


def share_of_outliers(fit: Any) -> float:
    """What the largest errors of a cloud add to the sum of all, if they look like outliers; else 0."""
    tolerance = min(float(fit.stats.get(f"tol_{name}", 0.0)) for name in ("average", "maximum"))
    errors = np.sort(np.asarray(fit.errors, float), axis=None)
    errors = errors[np.isfinite(errors)]
    few = errors[errors.size - int(FEW * errors.size) :]
    if fit.trimmed is not None or not few.size:
        return 0.0
    usual, share = np.median(errors), few.sum() / max(errors.sum(), np.finfo(float).tiny)
    # Where the average is small, the largest errors are those of points that do not count.
    counted = float(fit.average_error) > MOST * errors.mean()
    few_are_far = few[-1] > EXTREME * usual and share > MOST
    return float(share) if counted and few_are_far and usual <= NEAR * tolerance else 0.0


def with_outliers(fit: Any, sentence: str, share: float) -> str:
    """The reason, and that few points have most of the errors."""
    sentence = _without_advice(fit, sentence)
    advice = ", and leave them out or pass a method with loss=Tukey()" * ("loss" not in fit.stats)
    return (
        f"{sentence} {share:.0%} of all errors are those of {FEW:.0%} of the points; if these are outliers, "
        f"judge the surface by the others{advice}."
    )


def with_start(fit: Any, sentence: str) -> str:
    """The reason, and that the surface that the fit started from is nearer on average, if it is: squares may
    fall while that rises.
    """
    averages, now = np.asarray(fit.history.average), float(fit.average_error)
    if not (averages.ndim == 1 and averages.size and averages[0] < NEARER * now < np.inf):
        return sentence
    return f"{sentence} The surface that it started from is nearer on average ({100 * averages[0]:.3g} %)."


def with_sides(sentence: str, far: dict[str, Any]) -> str:
    """The reason, and that sides of the boundary are not where the points are."""
    *most, last = far
    sides = f"sides {', '.join(most)} and {last}" if most else f"side {last}"
    away = 100 * float(max(far.values()))
    return (
        f"{sentence} The points are {away:.2g} % of the diagonal away from {sides} of the boundary, to which "
        "the surface keeps; look whether it is theirs."
    )
