"""How the distance between neighbouring points becomes a step of the parameter."""

from typing import ClassVar

import equinox as eqx


class AbstractParametrisation(eqx.Module):
    """Steps of the parameter proportional to a power of the distance between neighbours.

    `exponent` is that power; the two final classes are `ChordLength` and `Centripetal`.
    """

    exponent: eqx.AbstractClassVar[float]


class ChordLength(AbstractParametrisation):
    """Steps proportional to the distance itself: close to arc length on well sampled data.

    Source: paper section 2.2; NURBS Book eq. 9.5.

    Examples
    --------
    >>> import jaxfit as jf
    >>> import numpy as np
    >>> print(np.round(jf.curve_parameters(np.asarray([[0.0], [1.0], [5.0]]), jf.ChordLength()), 8))
    [0.  0.2 1. ]
    """

    exponent: ClassVar[float] = 1.0


class Centripetal(AbstractParametrisation):
    """Steps proportional to the square root of the distance: calmer where spacing jumps.

    Source: paper section 2.2; E. T. Y. Lee, CAD 21 (1989); NURBS Book eq. 9.6.

    Examples
    --------
    >>> import jaxfit as jf
    >>> import numpy as np
    >>> [round(float(u), 3) for u in jf.curve_parameters(np.asarray([[0.0], [1.0], [5.0]]), jf.Centripetal())]
    [0.0, 0.333, 1.0]
    """

    exponent: ClassVar[float] = 0.5
