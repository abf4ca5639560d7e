"""The library for polygons, which only scans without boundary need."""

from typing import Any


def import_shapely() -> Any:
    """Shapely, imported when it is first needed.

    Raises
    ------
    ImportError
        If it is not installed, with the extra that brings it.
    """
    try:
        import shapely
    except ImportError as error:
        raise ImportError(
            "points without a boundary need shapely, which is not installed or does not load; "
            'pip install "jaxfit-surfaces[scan]", or pass a boundary.'
        ) from error
    return shapely
