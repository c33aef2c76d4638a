"""How light gets from the sources to the camera: the radiometric recursion, its stages, and the film."""

from rangecheck.transport.film import Film, image_irradiance
from rangecheck.transport.settings import DIRECT, FULL, Settings
from rangecheck.transport.tracer import Tracer

__all__ = ["DIRECT", "FULL", "Film", "Settings", "Tracer", "image_irradiance"]
