"""jaxfit: point data into B-spline surfaces, differentiably."""

from jaxfit import _interrupt as _interrupt  # first, for it acts on the other imports
from jaxfit._approximation import AtParameters as AtParameters
from jaxfit._approximation import ControlPointSums as ControlPointSums
from jaxfit._approximation import Discrepancy as Discrepancy
from jaxfit._approximation import Fairing as Fairing
from jaxfit._approximation import GaussNewton as GaussNewton
from jaxfit._approximation import GemanMcClure as GemanMcClure
from jaxfit._approximation import GeneralizedCrossValidation as GeneralizedCrossValidation
from jaxfit._approximation import GeometricApproximation as GeometricApproximation
from jaxfit._approximation import GlobalFeet as GlobalFeet
from jaxfit._approximation import Huber as Huber
from jaxfit._approximation import JaxoptGaussNewton as JaxoptGaussNewton
from jaxfit._approximation import JaxoptLevenbergMarquardt as JaxoptLevenbergMarquardt
from jaxfit._approximation import KnotInsertion as KnotInsertion
from jaxfit._approximation import LevenbergMarquardt as LevenbergMarquardt
from jaxfit._approximation import LocalFeet as LocalFeet
from jaxfit._approximation import Nesterov as Nesterov
from jaxfit._approximation import OrthogonalDistance as OrthogonalDistance
from jaxfit._approximation import RegularSmoothing as RegularSmoothing
from jaxfit._approximation import StandardApproximation as StandardApproximation
from jaxfit._approximation import Tukey as Tukey
from jaxfit._approximation import approximate as approximate
from jaxfit._approximation import fit_points as fit_points
from jaxfit._approximation import shard_points as shard_points
from jaxfit._base import Boundary as Boundary
from jaxfit._base import Coons as Coons
from jaxfit._base import DynamicBaseSurface as DynamicBaseSurface
from jaxfit._base import Greville as Greville
from jaxfit._base import Meshless as Meshless
from jaxfit._base import Uniform as Uniform
from jaxfit._base import base_surface as base_surface
from jaxfit._base import coons_surface as coons_surface
from jaxfit._base import meshless_parameters as meshless_parameters
from jaxfit._batch import PaddedClouds as PaddedClouds
from jaxfit._batch import map_fits as map_fits
from jaxfit._batch import pad_clouds as pad_clouds
from jaxfit._batch import worker_processes as worker_processes
from jaxfit._closest import ClosestPoint as ClosestPoint
from jaxfit._closest import HuWallner as HuWallner
from jaxfit._closest import Newton as Newton
from jaxfit._closest import PointStatus as PointStatus
from jaxfit._closest import closest_point as closest_point
from jaxfit._closest import update_feet as update_feet
from jaxfit._fit import RESULTS as RESULTS
from jaxfit._fit import AbstractIterativeMethod as AbstractIterativeMethod
from jaxfit._fit import ErrorHistory as ErrorHistory
from jaxfit._fit import Fit as Fit
from jaxfit._fit import FixedBorder as FixedBorder
from jaxfit._fit import FixedCorners as FixedCorners
from jaxfit._fit import FixedSides as FixedSides
from jaxfit._fit import FootPoints as FootPoints
from jaxfit._fit import FreeBorder as FreeBorder
from jaxfit._fit import History as History
from jaxfit._fit import ImplicitAdjoint as ImplicitAdjoint
from jaxfit._fit import Iterate as Iterate
from jaxfit._fit import Problem as Problem
from jaxfit._fit import StationarityCondition as StationarityCondition
from jaxfit._fit import UnrolledAdjoint as UnrolledAdjoint
from jaxfit._fit import WorkingSurface as WorkingSurface
from jaxfit._fit import held_points as held_points
from jaxfit._interpolation import Chebyshev as Chebyshev
from jaxfit._interpolation import ConstantWeight as ConstantWeight
from jaxfit._interpolation import GeometricInterpolation as GeometricInterpolation
from jaxfit._interpolation import NormalInterpolation as NormalInterpolation
from jaxfit._interpolation import OptimalRepositioning as OptimalRepositioning
from jaxfit._interpolation import Richardson as Richardson
from jaxfit._interpolation import StandardInterpolation as StandardInterpolation
from jaxfit._interpolation import UnitWeights as UnitWeights
from jaxfit._interpolation import interpolate as interpolate
from jaxfit._normal_equations import curvature_energy as curvature_energy
from jaxfit._parameters import Centripetal as Centripetal
from jaxfit._parameters import ChordLength as ChordLength
from jaxfit._parameters import curve_parameters as curve_parameters
from jaxfit._parameters import grid_parameters as grid_parameters
from jaxfit._program_folder import keep_programs as keep_programs
from jaxfit._quality import Regularity as Regularity
from jaxfit._quality import regularity as regularity
from jaxfit._quality import zebra as zebra
from jaxfit._splines import BezierCurves as BezierCurves
from jaxfit._splines import BezierPatches as BezierPatches
from jaxfit._splines import BSplineCurve as BSplineCurve
from jaxfit._splines import BSplineSurface as BSplineSurface
from jaxfit._splines import Curvature as Curvature
from jaxfit._splines import FirstForm as FirstForm
from jaxfit._splines import Reflection as Reflection
from jaxfit._splines import SecondForm as SecondForm
from jaxfit._splines import averaging_knots as averaging_knots
from jaxfit._splines import clamped_uniform_knots as clamped_uniform_knots
from jaxfit._splines import greville_abscissae as greville_abscissae
from jaxfit._splines import insertion_matrix as insertion_matrix
from jaxfit._splines import merge_knots as merge_knots
from jaxfit._streams import approximate_stream as approximate_stream
from jaxfit._trimmed import TrimmedSurface as TrimmedSurface
from jaxfit._version import __version__ as __version__


def __getattr__(name: str) -> object:
    """Load `jaxfit.io` and `jaxfit.plot` when they are first asked for."""
    if name in ("io", "plot"):
        import importlib

        return importlib.import_module(f"jaxfit.{name}")
    raise AttributeError(f"module 'jaxfit' has no attribute {name!r}")
