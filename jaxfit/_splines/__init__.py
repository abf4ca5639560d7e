"""B-spline curves and surfaces: pure mathematics, nothing about fitting."""

from jaxfit._splines._basis import find_span as find_span
from jaxfit._splines._bezier import BezierCurves as BezierCurves
from jaxfit._splines._bezier import BezierPatches as BezierPatches
from jaxfit._splines._curve import BSplineCurve as BSplineCurve
from jaxfit._splines._geometry import Curvature as Curvature
from jaxfit._splines._geometry import FirstForm as FirstForm
from jaxfit._splines._geometry import SecondForm as SecondForm
from jaxfit._splines._insertion import insertion_matrix as insertion_matrix
from jaxfit._splines._knots import averaging_knots as averaging_knots
from jaxfit._splines._knots import clamped_uniform_knots as clamped_uniform_knots
from jaxfit._splines._knots import greville_abscissae as greville_abscissae
from jaxfit._splines._knots import merge_knots as merge_knots
from jaxfit._splines._pieces import Pieces as Pieces
from jaxfit._splines._pieces import make_pieces as make_pieces
from jaxfit._splines._reflection import Reflection as Reflection
from jaxfit._splines._surface import BSplineSurface as BSplineSurface
