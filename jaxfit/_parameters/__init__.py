"""Parameters for points that have none yet: chord length and centripetal, curves and grids."""

from jaxfit._parameters._assign import GridParameters as GridParameters
from jaxfit._parameters._assign import curve_parameters as curve_parameters
from jaxfit._parameters._assign import grid_parameters as grid_parameters
from jaxfit._parameters._methods import AbstractParametrisation as AbstractParametrisation
from jaxfit._parameters._methods import Centripetal as Centripetal
from jaxfit._parameters._methods import ChordLength as ChordLength
