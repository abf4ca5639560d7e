"""Points in rows of one cell, and polynomials evaluated along them: what every fit's speed rests on."""

from jaxfit._cells._blocks import SLOTS_PER_BLOCK as SLOTS_PER_BLOCK
from jaxfit._cells._blocks import sum_over_blocks as sum_over_blocks
from jaxfit._cells._layout import cells_of as cells_of
from jaxfit._cells._layout import distances_at as distances_at
from jaxfit._cells._layout import local_coordinates as local_coordinates
from jaxfit._cells._layout import row_coefficients as row_coefficients
from jaxfit._cells._layout import rows_of as rows_of
from jaxfit._cells._layout import take as take
from jaxfit._cells._layout import values_at as values_at
from jaxfit._cells._overlap import overlap_add as overlap_add
from jaxfit._cells._polynomials import Jet as Jet
from jaxfit._cells._polynomials import evaluate_first_order as evaluate_first_order
from jaxfit._cells._polynomials import evaluate_jet as evaluate_jet
from jaxfit._cells._polynomials import evaluate_values as evaluate_values
from jaxfit._cells._polynomials import powers as powers
from jaxfit._cells._rows import Rows as Rows
from jaxfit._cells._rows import make_rows as make_rows
from jaxfit._cells._rows import make_single_rows as make_single_rows
from jaxfit._cells._rows import narrow_width as narrow_width
from jaxfit._cells._rows import row_width as row_width
from jaxfit._cells._sums import cells_to_net as cells_to_net
from jaxfit._cells._sums import row_moments as row_moments
