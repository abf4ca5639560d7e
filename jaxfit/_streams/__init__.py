"""Fits of clouds that do not fit in memory, in passes over blocks of their points."""

from jaxfit._streams._approximate_stream import approximate_stream as approximate_stream
