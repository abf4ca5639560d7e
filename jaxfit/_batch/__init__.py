"""Many fits in one call."""

from jaxfit._batch._map_fits import map_fits
from jaxfit._batch._pad_clouds import PaddedClouds, pad_clouds
from jaxfit._batch._worker_processes import worker_processes

__all__ = ["PaddedClouds", "map_fits", "pad_clouds", "worker_processes"]
