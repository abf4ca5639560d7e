"""How a fit can end: an enumeration whose values are the sentences that users read."""

import equinox as eqx


class RESULTS(eqx.Enumeration):
    """Why a fit stopped. Compare with `fit.result == RESULTS.converged`."""

    running = "the fit has not finished."
    converged = "all tolerances are met."
    max_steps_reached = (
        "the maximum number of iterations was reached before the tolerances were met; raise max_steps "
        "or loosen the tolerances."
    )
    stalled = (
        "the errors have stopped falling above the tolerances; loosen these, use more control points or a "
        "better base surface for a cloud, or StandardInterpolation for a grid."
    )
    diverged = (
        "the iteration produced numbers that are not finite or errors that grow, and was taken back to the "
        "last good surface; check the base surface and the scale of the data."
    )
    rounded = (
        "the tolerance was met until the control points were rounded; loosen it, work in float64, or, if the "
        "data is far from the origin, subtract its centre."
    )
    normals_missed = (
        "some normals lie in the surface through the points or on its other side, so that it would have to "
        "fold; check their directions and signs."
    )
