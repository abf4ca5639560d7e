"""The fit of a cloud that cannot be fitted."""

from typing import Any

import jax
import numpy as np

from jaxfit._approximation._approximate import default_method
from jaxfit._approximation._cloud_fit import stats_of, tolerances_of
from jaxfit._batch._broadcast import Request
from jaxfit._fit._history import History
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._result import Fit
from jaxfit._fit._scaling import Unit
from jaxfit._precision import working_dtype


def failed_fit(request: Request, options: dict[str, Any], why: str) -> Fit:
    """A fit that ended before its first iteration, `why` in a sentence: the base surface, and no errors."""
    base, count, dtype = request.base, len(np.atleast_1d(request.cloud)), working_dtype()
    nothing, none = np.full(count, np.nan, dtype), np.zeros(1, np.int32)
    once, never = np.full(1, np.nan, dtype), np.zeros(1, bool)
    net = np.asarray([base.shape], np.int32)
    arrays = jax.device_put((nothing, np.asarray(np.nan, dtype)))
    history = jax.device_put((once, once, once, once, none, net, never, never))
    tolerances = tolerances_of(options["tol_average"], options["tol_maximum"], options["max_steps"])
    unknown = Unit(centre=np.nan, scale=np.nan, diagonal=np.nan)
    return Fit(
        surface=base,
        u=arrays[0],
        v=arrays[0],
        errors=arrays[0],
        average_error=arrays[1],
        maximum_error=arrays[1],
        history=History(*history),
        result=RESULTS.diverged,
        stats={
            **stats_of(default_method(request.method), tolerances, 0, unknown, count),
            "refused": why,
        },
    )
