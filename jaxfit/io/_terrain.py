"""A real data set that is already on the machine: the terrain inside Matplotlib."""

from typing import Any

import numpy as np

from jaxfit.io._point_data import InputError, PointData, grid_data

_EARTH_RADIUS = 6371008.8  # metres, the mean radius


def jacksboro() -> PointData:
    """The terrain round the Jacksboro fault, Tennessee, that Matplotlib carries along.

    Longitudes and latitudes become metres on a sphere of radius 6,371,008.8 m about the middle
    of the piece: x = R cos(latitude of the middle) (longitude - middle), y = R (latitude -
    middle). The first grid index runs east, the second south.

    Returns
    -------
    PointData
        A grid of 403 x 344 points, 43 km across, heights in whole metres; its four edges are the
        boundary.

    Raises
    ------
    InputError
        If Matplotlib is not installed.

    Examples
    --------
    >>> jf.io.jacksboro().grid.shape
    (403, 344, 3)
    """
    try:
        from matplotlib.cbook import get_sample_data
    except ImportError as error:
        raise InputError(
            "the jacksboro terrain comes with Matplotlib, which is not installed; "
            'pip install "jaxfit-surfaces[plot]".'
        ) from error
    opened: Any = get_sample_data("jacksboro_fault_dem.npz")
    with opened as sample:
        heights = sample["elevation"].astype(np.float64)
        west, north = float(sample["xmin"]), float(sample["ymin"])  # ymin is the northern edge
        step_east, step_south = float(sample["dx"]), float(sample["dy"])
    rows, columns = heights.shape
    longitude = west + np.arange(columns) * step_east
    latitude = north - np.arange(rows) * step_south
    shrink = np.cos(np.deg2rad(latitude.mean()))
    x = np.deg2rad(longitude - longitude.mean()) * _EARTH_RADIUS * shrink
    y = np.deg2rad(latitude - latitude.mean()) * _EARTH_RADIUS
    grid = np.stack([*np.meshgrid(x, y, indexing="ij"), heights.T], axis=-1)
    return grid_data(grid, "jacksboro")
