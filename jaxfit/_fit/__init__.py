"""Fits: one verb per problem, one object per method, one kind of result."""

from jaxfit._fit._adjoint import ImplicitAdjoint as ImplicitAdjoint
from jaxfit._fit._adjoint import UnrolledAdjoint as UnrolledAdjoint
from jaxfit._fit._approximate import approximate as approximate
from jaxfit._fit._approximate import fit_points as fit_points
from jaxfit._fit._automatic_smoothing import Discrepancy as Discrepancy
from jaxfit._fit._automatic_smoothing import GeneralizedCrossValidation as GeneralizedCrossValidation
from jaxfit._fit._fairing import Fairing as Fairing
from jaxfit._fit._fit_result import Fit as Fit
from jaxfit._fit._fit_result import History as History
from jaxfit._fit._frozen import Chebyshev as Chebyshev
from jaxfit._fit._frozen import Richardson as Richardson
from jaxfit._fit._geometric_approximation import GeometricApproximation as GeometricApproximation
from jaxfit._fit._geometric_interpolation import GeometricInterpolation as GeometricInterpolation
from jaxfit._fit._growth import KnotInsertion as KnotInsertion
from jaxfit._fit._interpolate import interpolate as interpolate
from jaxfit._fit._jaxopt import JaxoptGaussNewton as JaxoptGaussNewton
from jaxfit._fit._jaxopt import JaxoptLevenbergMarquardt as JaxoptLevenbergMarquardt
from jaxfit._fit._least_squares import GaussNewton as GaussNewton
from jaxfit._fit._least_squares import LevenbergMarquardt as LevenbergMarquardt
from jaxfit._fit._normal_interpolation import NormalInterpolation as NormalInterpolation
from jaxfit._fit._repositioning import ConstantWeight as ConstantWeight
from jaxfit._fit._repositioning import OptimalRepositioning as OptimalRepositioning
from jaxfit._fit._repositioning import UnitWeights as UnitWeights
from jaxfit._fit._results import RESULTS as RESULTS
from jaxfit._fit._standard_approximation import StandardApproximation as StandardApproximation
from jaxfit._fit._standard_interpolation import StandardInterpolation as StandardInterpolation
