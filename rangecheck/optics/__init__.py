"""Camera models shared by scanner and renderer, lenses and sensors."""

from rangecheck.optics.cameras import Camera, CylindricalCamera, OrthographicCamera, PinholeCamera, RayGrid, camera_from_dict
from rangecheck.optics.lens import ThinLens
from rangecheck.optics.sensor import Sensor

__all__ = [
    "Camera",
    "CylindricalCamera",
    "OrthographicCamera",
    "PinholeCamera",
    "RayGrid",
    "Sensor",
    "ThinLens",
    "camera_from_dict",
]
