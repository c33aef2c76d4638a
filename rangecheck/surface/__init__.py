"""Surfaces: triangles that know which part they belong to and how they came to be."""

from rangecheck.surface.surface import INTERPOLATED, INVENTED, MEASURED, ORIGIN_NAMES, Surface

__all__ = ["INTERPOLATED", "INVENTED", "MEASURED", "ORIGIN_NAMES", "Surface"]
