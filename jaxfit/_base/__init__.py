"""Base surfaces: a first surface from four boundary polylines, and from the cloud where a method uses it."""

from jaxfit._base._base_method import AbstractBaseMethod as AbstractBaseMethod
from jaxfit._base._base_method import Coons as Coons
from jaxfit._base._base_surface import base_surface as base_surface
from jaxfit._base._boundary import Boundary as Boundary
from jaxfit._base._carried_base import carried_base as carried_base
from jaxfit._base._coons import AbstractAbscissae as AbstractAbscissae
from jaxfit._base._coons import Greville as Greville
from jaxfit._base._coons import Uniform as Uniform
from jaxfit._base._coons import coons_surface as coons_surface
from jaxfit._base._default_base import default_base as default_base
from jaxfit._base._default_net import MOST_CONTROL_POINTS as MOST_CONTROL_POINTS
from jaxfit._base._default_net import check_net_of_cloud as check_net_of_cloud
from jaxfit._base._default_net import checked_net as checked_net
from jaxfit._base._default_net import default_net as default_net
from jaxfit._base._default_net import default_size as default_size
from jaxfit._base._default_net import net_of_ratio as net_of_ratio
from jaxfit._base._default_net import net_of_size as net_of_size
from jaxfit._base._delaunay_stars import COCIRCULAR as COCIRCULAR
from jaxfit._base._delaunay_stars import Planes as Planes
from jaxfit._base._delaunay_stars import Stars as Stars
from jaxfit._base._delaunay_stars import stars as stars
from jaxfit._base._delaunay_stars import supported_planes as supported_planes
from jaxfit._base._dynamic import DynamicBaseSurface as DynamicBaseSurface
from jaxfit._base._free_base import free_base as free_base
from jaxfit._base._meshless import Meshless as Meshless
from jaxfit._base._meshless_parameters import meshless_parameters as meshless_parameters
