"""How good a surface is, whatever it was fitted to: folds, parameter lines, energies, zebra stripes."""

from jaxfit._quality._regularity import Regularity as Regularity
from jaxfit._quality._regularity import regularity as regularity
from jaxfit._quality._zebra import zebra as zebra
