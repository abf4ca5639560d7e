"""Closest points on curves and surfaces."""

from jaxfit._closest._closest_point import ClosestPoint as ClosestPoint
from jaxfit._closest._closest_point import PointStatus as PointStatus
from jaxfit._closest._closest_point import closest_point as closest_point
from jaxfit._closest._follow import follow as follow
from jaxfit._closest._implicit import as_feet as as_feet
from jaxfit._closest._on_host import globally as globally
from jaxfit._closest._on_host import padded as padded
from jaxfit._closest._on_host import prepare as prepare
from jaxfit._closest._passes import Border as Border
from jaxfit._closest._passes import box_of as box_of
from jaxfit._closest._project import project as project
from jaxfit._closest._steps import AbstractFootMethod as AbstractFootMethod
from jaxfit._closest._steps import HuWallner as HuWallner
from jaxfit._closest._steps import Newton as Newton
