"""Maps: what a surface is to a camera before any light falls on it."""

from rangecheck.maps.deviation import SeenDeviation, deviation_seen
from rangecheck.maps.inside import require_outside, winding_number
from rangecheck.maps.proof import BackProjection, back_projection_error
from rangecheck.maps.secondary import Chain, smooth_normals, trace_chain
from rangecheck.maps.shadow import Shadows, trace_shadows, values_seen
from rangecheck.maps.trace import Maps, trace_maps

__all__ = [
    "BackProjection",
    "Chain",
    "Maps",
    "SeenDeviation",
    "Shadows",
    "back_projection_error",
    "deviation_seen",
    "require_outside",
    "smooth_normals",
    "trace_chain",
    "trace_maps",
    "trace_shadows",
    "values_seen",
    "winding_number",
]
