"""Surfaces near a cloud of points."""

from jaxfit._approximation._approximate import approximate as approximate
from jaxfit._approximation._automatic_smoothing import Discrepancy as Discrepancy
from jaxfit._approximation._automatic_smoothing import (
    GeneralizedCrossValidation as GeneralizedCrossValidation,
)
from jaxfit._approximation._control_point_sums import ControlPointSums as ControlPointSums
from jaxfit._approximation._errors import AtParameters as AtParameters
from jaxfit._approximation._errors import GlobalFeet as GlobalFeet
from jaxfit._approximation._errors import LocalFeet as LocalFeet
from jaxfit._approximation._fit_points import fit_points as fit_points
from jaxfit._approximation._geometric import GeometricApproximation as GeometricApproximation
from jaxfit._approximation._jaxopt_solvers import JaxoptGaussNewton as JaxoptGaussNewton
from jaxfit._approximation._jaxopt_solvers import JaxoptLevenbergMarquardt as JaxoptLevenbergMarquardt
from jaxfit._approximation._knot_insertion import KnotInsertion as KnotInsertion
from jaxfit._approximation._linear_least_squares import GaussNewton as GaussNewton
from jaxfit._approximation._linear_least_squares import LevenbergMarquardt as LevenbergMarquardt
from jaxfit._approximation._losses import GemanMcClure as GemanMcClure
from jaxfit._approximation._losses import Huber as Huber
from jaxfit._approximation._losses import Tukey as Tukey
from jaxfit._approximation._nesterov import Nesterov as Nesterov
from jaxfit._approximation._net_fairing import Fairing as Fairing
from jaxfit._approximation._orthogonal import OrthogonalDistance as OrthogonalDistance
from jaxfit._approximation._regular_smoothing import RegularSmoothing as RegularSmoothing
from jaxfit._approximation._shards import shard_points as shard_points
from jaxfit._approximation._standard import StandardApproximation as StandardApproximation
