"""What all fits share: the loop, the reasons it stops for, the history and the result."""

from jaxfit._fit._reasons import RESULTS as RESULTS
from jaxfit._fit._result import Fit as Fit
from jaxfit._fit._result import History as History
