"""Closest points on curves and surfaces."""

from jaxfit._closest._closest_point import ClosestPoint as ClosestPoint
from jaxfit._closest._closest_point import PointStatus as PointStatus
from jaxfit._closest._closest_point import closest_point as closest_point
from jaxfit._closest._foot_methods import AbstractFootMethod as AbstractFootMethod
from jaxfit._closest._foot_methods import HuWallner as HuWallner
from jaxfit._closest._foot_methods import Newton as Newton
from jaxfit._closest._foot_update import FootUpdate as FootUpdate
from jaxfit._closest._foot_update import update_feet as update_feet
from jaxfit._closest._forms import dot as dot
from jaxfit._closest._implicit import as_feet as as_feet
from jaxfit._closest._iterate_feet import PointSums as PointSums
from jaxfit._closest._nearest_feet import HostFeet as HostFeet
from jaxfit._closest._nearest_feet import chunk_size as chunk_size
from jaxfit._closest._nearest_feet import nearest_feet as nearest_feet
from jaxfit._closest._project import ParameterBounds as ParameterBounds
from jaxfit._closest._project import project as project
