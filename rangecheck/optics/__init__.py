"""Camera models shared by scanner and renderer."""

from rangecheck.optics.cameras import Camera, CylindricalCamera, OrthographicCamera, PinholeCamera, RayGrid, camera_from_dict

__all__ = ["Camera", "CylindricalCamera", "OrthographicCamera", "PinholeCamera", "RayGrid", "camera_from_dict"]
