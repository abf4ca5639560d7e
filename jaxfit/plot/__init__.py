"""Pictures of fits; needs Matplotlib (``pip install "jaxfit-surfaces[plot]"``)."""

from jaxfit.plot._history import history
from jaxfit.plot._loops import loops
from jaxfit.plot._picture import surface_and_errors
from jaxfit.plot._report import report
from jaxfit.plot._zebra import zebra_stripes

__all__ = ["history", "loops", "report", "surface_and_errors", "zebra_stripes"]
