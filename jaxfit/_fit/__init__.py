"""What all fits share: the loop, the contract of methods, the history and the result."""

from jaxfit._fit._adjoints import ImplicitAdjoint as ImplicitAdjoint
from jaxfit._fit._adjoints import UnrolledAdjoint as UnrolledAdjoint
from jaxfit._fit._border import FixedBorder as FixedBorder
from jaxfit._fit._border import FixedCorners as FixedCorners
from jaxfit._fit._border import FixedSides as FixedSides
from jaxfit._fit._border import FreeBorder as FreeBorder
from jaxfit._fit._border import held_points as held_points
from jaxfit._fit._foot_points import FootPoints as FootPoints
from jaxfit._fit._history import ErrorHistory as ErrorHistory
from jaxfit._fit._history import History as History
from jaxfit._fit._method import AbstractIterativeMethod as AbstractIterativeMethod
from jaxfit._fit._method import Iterate as Iterate
from jaxfit._fit._problem import Problem as Problem
from jaxfit._fit._reasons import RESULTS as RESULTS
from jaxfit._fit._result import Fit as Fit
from jaxfit._fit._stationarity_condition import StationarityCondition as StationarityCondition
from jaxfit._fit._working_surface import WorkingSurface as WorkingSurface
