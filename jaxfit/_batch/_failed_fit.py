"""The fit of a cloud that is not finite."""

from typing import Any

import jax
import numpy as np

from jaxfit._approximation._approximate import default_method
from jaxfit._fit._history import History
from jaxfit._fit._reasons import RESULTS
from jaxfit._fit._result import Fit, Name
from jaxfit._precision import working_dtype
from jaxfit._splines import BSplineSurface


def failed_fit(cloud: Any, base: BSplineSurface, method: Any) -> Fit:
    """A fit that ended before its first iteration: the base surface, and no errors."""
    count, dtype = len(cloud), working_dtype()
    nothing, none = np.full(count, np.nan, dtype), np.zeros(1, np.int32)
    once, never = np.full(1, np.nan, dtype), np.zeros(1, bool)
    net = np.asarray([base.shape], np.int32)
    arrays = jax.device_put((nothing, np.asarray(np.nan, dtype)))
    history = jax.device_put((once, once, once, once, none, net, never, never))
    stats = {
        "method": Name(type(default_method(method)).__name__),
        "num_steps": 0,
        "diagonal": np.nan,
        "unconverged_feet": count,
    }
    return Fit(
        surface=base,
        u=arrays[0],
        v=arrays[0],
        errors=arrays[0],
        average_error=arrays[1],
        maximum_error=arrays[1],
        history=History(*history),
        result=RESULTS.diverged,
        stats=stats,
    )
