"""Surfaces through all points of a grid."""

from jaxfit._interpolation._fixed_parameters import Chebyshev as Chebyshev
from jaxfit._interpolation._fixed_parameters import Richardson as Richardson
from jaxfit._interpolation._geometric import GeometricInterpolation as GeometricInterpolation
from jaxfit._interpolation._hermite import NormalInterpolation as NormalInterpolation
from jaxfit._interpolation._interpolate import interpolate as interpolate
from jaxfit._interpolation._standard import StandardInterpolation as StandardInterpolation
from jaxfit._interpolation._step_weights import ConstantWeight as ConstantWeight
from jaxfit._interpolation._step_weights import OptimalRepositioning as OptimalRepositioning
from jaxfit._interpolation._step_weights import UnitWeights as UnitWeights
