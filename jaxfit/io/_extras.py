"""Libraries that only some file formats need."""

import importlib
from types import ModuleType

from jaxfit.io._point_data import InputError, one_line


def import_extra(module: str, suffix: str, extra: str) -> ModuleType:
    """Import what files of this suffix need.

    Raises
    ------
    InputError
        If it is not installed, or does not load, with the extra that brings it.
    """
    remedy = f'pip install "jaxfit-surfaces[{extra}]"'
    package = module.split(".")[0]
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise InputError(f"{suffix} files need {package}, which is not installed; {remedy}.") from error
    except (ImportError, OSError) as error:
        raise InputError(
            f"{suffix} files need {package}, which does not load here ({one_line(error)}); {remedy} again."
        ) from error
