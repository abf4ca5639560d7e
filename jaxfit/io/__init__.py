"""Files in and out: points and grids to fit, surfaces that were fitted; no mathematics."""

from jaxfit.io._output import check_output
from jaxfit.io._point_data import InputError, PointData
from jaxfit.io._points import read_boundary, read_points
from jaxfit.io._surfaces import read_surface, write_surface
from jaxfit.io._terrain import jacksboro

__all__ = [
    "InputError",
    "PointData",
    "check_output",
    "jacksboro",
    "read_boundary",
    "read_points",
    "read_surface",
    "write_surface",
]
