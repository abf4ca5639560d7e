"""The text of a printed fit."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from jaxfit._checks import is_concrete
from jaxfit._splines import BSplineSurface

if TYPE_CHECKING:
    from jaxfit._fit._result import Fit


def facts(fit: Any) -> dict[str, str]:
    """Names and values for a table: net, order, iterations, errors in per cent, and why the fit stopped."""
    return {
        "net": "{} x {}".format(*fit.surface.shape),
        "order": "{} x {}".format(*fit.surface.order),
        "iterations": str(int(fit.stats["num_steps"])),
        "average error": f"{100 * float(fit.average_error):.4g} % of the diagonal",
        "maximum error": f"{100 * float(fit.maximum_error):.4g} % of the diagonal",
        "stopped": fit.message,
    }


def describe(fit: "Fit") -> str:
    """`str(fit)`: its `facts`, one a line; the shapes of its arrays where it is traced or one of a batch."""
    if not _is_single(fit):
        return eqx.tree_pformat(fit)
    rows = {"method": str(fit.stats.get("method", "interpolation")), **facts(fit)}
    return "\n".join(f"{name:<15}{value}" for name, value in rows.items())


def describe_briefly(fit: "Fit") -> str:
    """`repr(fit)`, on one line."""
    if not _is_single(fit):
        return eqx.tree_pformat(fit)
    said = facts(fit)
    errors = ", ".join(f"{which} error {said[f'{which} error']}" for which in ("average", "maximum"))
    return f"<Fit: {said['net']} control points, {errors.replace(' of the diagonal,', ',')}; {fit.message}>"


def _is_single(fit: "Fit") -> bool:
    if not (isinstance(fit.surface, BSplineSurface) and is_concrete(fit)):
        return False
    numbers = [np.asarray(x) for x in (fit.average_error, fit.maximum_error, fit.stats.get("num_steps"))]
    return all(x.ndim == 0 and x.dtype.kind in "fiu" for x in numbers)
