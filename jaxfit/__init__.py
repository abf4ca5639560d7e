"""jaxfit: point data into B-spline surfaces, differentiably."""

__version__ = "0.1.0"

from jaxfit._closest import ClosestPoint as ClosestPoint
from jaxfit._closest import HuWallner as HuWallner
from jaxfit._closest import Newton as Newton
from jaxfit._closest import PointStatus as PointStatus
from jaxfit._closest import closest_point as closest_point
from jaxfit._splines import BSplineCurve as BSplineCurve
from jaxfit._splines import BSplineSurface as BSplineSurface
