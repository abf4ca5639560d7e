"""`python -m jaxfit` is the command `jaxfit`."""

import sys

from jaxfit._cli import main

if __name__ == "__main__":
    sys.exit(main())
