"""`RESULTS`: the reasons for which a fit stops, each with its sentence."""

from typing import Any

import equinox as eqx
import numpy as np

from jaxfit._checks import is_concrete


class RESULTS(eqx.Enumeration):
    """Why a fit stopped. Compare with `fit.result == RESULTS.converged`.

    Examples
    --------
    >>> print(jf.RESULTS[jf.RESULTS.converged])
    all tolerances are met.
    """

    running = "the fit has not finished."
    converged = "all tolerances are met."
    max_steps_reached = (
        "the maximum number of iterations was reached before the tolerances were met; raise max_steps "
        "or loosen the tolerances."
    )
    stalled = (
        "the errors have stopped falling above the tolerances; loosen these, or try another method or, of a "
        "cloud, more control points or a better base surface."
    )
    noise_reached = (
        "finer nets bring the surface no nearer to points that were held out: what is left above the "
        "tolerances is noise, or detail between the points; loosen the tolerances."
    )
    net_exhausted = (
        "the tolerances are not met with the largest net that is tried for this number of points; loosen "
        "them, or pass a net."
    )
    diverged = (
        "the computation produced numbers that are not finite or errors that grow, and went back to the last "
        "good surface if there was one; check the data and the base surface."
    )
    rounded = (
        "the rounding of the control points keeps the errors above the tolerance; loosen it, work in float64 "
        "(the flag jax_enable_x64 of jax.config) or, if the data is far from the origin, subtract its centre."
    )
    normals_missed = (
        "some normals lie in the surface through the points or on its other side, so that it would have to "
        "fold; check their directions and signs."
    )


def code_of(result: Any) -> int:
    """The number behind an item of RESULTS."""
    return int(np.asarray(result._value))


def result_of(code: Any) -> Any:
    """The item of RESULTS with this number, traced or not."""
    item: Any = type(RESULTS.running)
    return item(np.asarray(code, np.int32) if is_concrete(code) else code, RESULTS)
