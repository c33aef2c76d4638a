"""Sequences of frames: the orbit they are seen from, and the files they become."""

from rangecheck.animation.frames import pilot_indices, render_frames
from rangecheck.animation.orbit import Orbit, framing_error_px, orbit_around

__all__ = ["Orbit", "framing_error_px", "orbit_around", "pilot_indices", "render_frames"]
