"""Points in rows of one cell, and polynomials evaluated along them: what every fit's speed rests on."""

from jaxfit._cells._polynomials import Jet as Jet
from jaxfit._cells._polynomials import evaluate_jet as evaluate_jet
from jaxfit._cells._polynomials import evaluate_values as evaluate_values
from jaxfit._cells._rows import Rows as Rows
from jaxfit._cells._rows import make_rows as make_rows
from jaxfit._cells._rows import row_width as row_width
from jaxfit._cells._stage import staged as staged
