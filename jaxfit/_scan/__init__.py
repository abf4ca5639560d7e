"""From a raw scan to a sheet: cleaning, a mesh, its loops, and parameters."""

from jaxfit._scan._nodata import check_measured as check_measured
from jaxfit._scan._nodata import is_nodata as is_nodata
from jaxfit._scan._sheet import Layout as Layout
from jaxfit._scan._sheet import Sheet as Sheet
from jaxfit._scan._sheet import sheet_of as sheet_of
from jaxfit._scan._trim_loops import node_feet as node_feet
from jaxfit._scan._trim_loops import trim_loops as trim_loops
