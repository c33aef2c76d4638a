"""How far a range finder errs: standard deviations of range in mm, each from its source.

r is range, w the working distance at which the stated noise holds, theta the angle of incidence at the camera.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import FloatArray

#: whose law each noise model is
SOURCES = {
    "quadratic": "Besl 1988",
    "speckle": "Dorsch, Hausler, Herrmann 1994",
    "kinect": "Nguyen, Izadi, Lovell 2012",
    "photon": "Lange, Seitz 2001",
}
SPEED_OF_LIGHT_MM_S = 299_792_458_000.0


def quadratic_noise(noise_mm: float, range_mm: FloatArray, cos_camera: FloatArray, working_distance_mm: float) -> FloatArray:
    """noise_mm (r / w)^2 / cos theta: a fixed error of disparity, dr = r^2 d(disparity) / (f b), stretched on oblique surfaces
    (Besl, *Active, optical range imaging sensors*, Machine Vision and Applications 1, 1988)."""
    return noise_mm * (range_mm / working_distance_mm) ** 2 / cos_camera


def speckle_noise(
    wavelength_um: float, contrast: float, aperture_mm: float, range_mm: FloatArray, triangulation_rad: FloatArray
) -> FloatArray:
    """C lambda / (2 pi sin u sin phi): what coherent light leaves uncertain, u being half the angle of the lens as seen from the surface and
    phi the angle between illumination and observation (Dorsch, Hausler, Herrmann, *Laser triangulation: fundamental uncertainty in
    distance measurement*, Applied Optics 33(7), 1994)."""
    sin_u = aperture_mm / (2.0 * np.hypot(range_mm, aperture_mm / 2.0))
    return contrast * wavelength_um * 1e-3 / (2.0 * math.pi * sin_u * np.sin(triangulation_rad))


def kinect_noise(depth_mm: FloatArray, theta_rad: FloatArray) -> FloatArray:
    """Axial noise of the first Kinect: 1.2 + 1.9 (z - 0.4)^2 + 0.1 theta^2 / (sqrt z (pi/2 - theta)^2) mm, z in metres (Nguyen, Izadi,
    Lovell, *Modeling Kinect sensor noise for improved 3D reconstruction and tracking*, 3DIMPVT 2012). Measured from 0.9 to 3 m."""
    z = depth_mm * 1e-3
    return 1.2 + 1.9 * (z - 0.4) ** 2 + 0.1 / np.sqrt(z) * (theta_rad / (0.5 * math.pi - theta_rad)) ** 2


def photon_noise(noise_mm: float, signal: FloatArray, ambient: float) -> FloatArray:
    """noise_mm sqrt(A + B) / A: shot noise of a demodulated signal A under constant light B (Lange & Seitz, *Solid-state time-of-flight
    range camera*, IEEE J. Quantum Electronics 37(3), 2001), noise_mm being that of A = 1, B = 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return noise_mm * np.sqrt(signal + ambient) / signal
