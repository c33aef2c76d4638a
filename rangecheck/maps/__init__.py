"""Maps: what a surface is to a camera before any light falls on it."""

from rangecheck.maps.inside import require_outside, winding_number
from rangecheck.maps.proof import BackProjection, back_projection_error
from rangecheck.maps.trace import Maps, trace_maps

__all__ = ["BackProjection", "Maps", "back_projection_error", "require_outside", "trace_maps", "winding_number"]
