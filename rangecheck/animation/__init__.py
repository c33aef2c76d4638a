"""Sequences of frames: the orbit they are seen from, and the files they become."""

from rangecheck.animation.consistency import Consistency, faces_seen, measure_consistency, outline_of, verdict_for
from rangecheck.animation.frames import pilot_indices, render_frames
from rangecheck.animation.orbit import Orbit, framing_error_px, orbit_around
from rangecheck.animation.speckle import Speckle, speckle_of

__all__ = [
    "Consistency",
    "Orbit",
    "Speckle",
    "faces_seen",
    "framing_error_px",
    "measure_consistency",
    "orbit_around",
    "outline_of",
    "pilot_indices",
    "render_frames",
    "speckle_of",
    "verdict_for",
]
