"""Surfaces cut to a region of their parameters: loops, membership, area, triangles."""

from jaxfit._trimmed._trimmed_surface import TrimmedSurface

__all__ = ["TrimmedSurface"]
