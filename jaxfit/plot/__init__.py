"""Pictures of fits; needs Matplotlib (``pip install 'jaxfit-surfaces[plot]'``)."""

from jaxfit.plot._picture import surface_and_errors

__all__ = ["surface_and_errors"]
