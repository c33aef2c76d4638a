"""What a picture is taken with - lens, distortion, vignetting, sensor - and only as much of it as can be seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.config import Settings
from rangecheck.errors import SettingError
from rangecheck.export.pictures import develop
from rangecheck.maps import trace_maps
from rangecheck.optics import Camera, CylindricalCamera, OrthographicCamera, PinholeCamera, Sensor, ThinLens
from rangecheck.optics.lens import SHARP_PX
from rangecheck.rigid import about_axis, inverse, move_points
from rangecheck.surface import Surface
from rangecheck.transport import Film, Plan, Tracer
from rangecheck.transport import render as render_film
from rangecheck.transport.defocus import defocus

#: distortion that moves no point of the frame further than this, in pixels, is left out
STRAIGHT_PX = 0.1
#: radiance behind the object, where white that faces the key light has 1: an even, dark backdrop, whatever the surroundings
BACKDROP = 0.05


@dataclass(frozen=True)
class Optics:
    """`camera` is what rays are made by, `asked` what the settings say; they differ where distortion is too small to be seen."""

    camera: Camera
    asked: Camera
    lens: ThinLens | None
    vignetting: bool
    sensor: Sensor | None
    reasons: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: what else than the pinhole belongs to a picture."""
        found: dict[str, Any] = {"vignetting": self.vignetting}
        if self.lens is not None:
            lengths = ("aperture_mm", "focus_mm", "focal_length_mm", "rim_mm", "rim_distance_mm")
            found["lens"] = {name: getattr(self.lens, name) for name in lengths}
        if self.sensor is not None:
            names = ("full_well", "read_noise", "dark_electrons", "bits", "response", "gamma")
            found["sensor"] = {name: getattr(self.sensor, name) for name in names}
        return found

    def falloff(self) -> FloatArray | None:
        """(h, w) image irradiance over that on the axis, equation (15); None where it is not asked for."""
        if not self.vignetting:
            return None
        cosine = self.camera.pixel_rays()[1][..., 2]
        if self.lens is None:
            return cosine**4
        return cosine**4 * self.lens.rim_share(np.sqrt(1 - cosine**2) / cosine)


def camera_of(settings: Settings) -> PinholeCamera:
    """The pinhole camera of the settings, with its distortion. Raises SettingError where they ask for another."""
    picture = settings.picture
    if picture.camera != "pinhole":
        raise SettingError(
            f"picture.camera is {picture.camera}; render and maps take such pictures (and draw orthographic ones); all else needs pinhole",
            key="picture.camera",
        )
    camera = PinholeCamera.from_field_of_view(picture.width, picture.height, picture.field_of_view_deg)
    return replace(camera, distortion=tuple(picture.distortion)) if any(picture.distortion) else camera


def lensless(settings: Settings, surface: Surface, world_from_camera: FloatArray) -> tuple[Camera, FloatArray]:
    """The orthographic or cylindrical camera of the settings and its pose, for somebody at `world_from_camera` who looks at `surface`.

    The orthographic one is at that pose. The cylindrical one stands upright (y) about the middle of the surface, as far away as that
    pose, and has its direction in the middle of the picture. Without picture.pixel_mm the surface fills the frame less
    turntable.margin. Raises SettingError for what only a lens has, and where the surface passes the cylinder."""
    picture = settings.picture
    for key, value in (
        ("distortion", any(picture.distortion)),
        ("aperture_mm", picture.aperture_mm),
        ("vignetting", picture.vignetting),
    ):
        if value:
            raise SettingError(
                f"picture.{key} belongs to a lens; a {picture.camera} camera has none, so leave it out", key=f"picture.{key}"
            )
    across, down = (picture.width - 1) / 2, (picture.height - 1) / 2
    room = 1 - 2 * settings.turntable.margin
    points = surface.vertices[np.unique(surface.faces)]
    if picture.camera == "orthographic":
        seen = np.abs(move_points(inverse(world_from_camera), points)[:, :2]).max(axis=0)
        pixel = picture.pixel_mm or 2 * float((seen / (picture.width, picture.height)).max()) / room or 1.0
        return OrthographicCamera(picture.width, picture.height, pixel, across, down), world_from_camera
    middle = surface.bounds_mm.mean(axis=0)
    away = world_from_camera[:3, 3] - middle
    radius, front = float(np.hypot(away[0], away[2])), float(np.arctan2(away[0], away[2]))
    reach = float(np.hypot(points[:, 0] - middle[0], points[:, 2] - middle[2]).max())
    if radius <= reach:
        raise SettingError(
            f"the cylindrical camera is {radius:.4g} mm from the upright axis through the object, which reaches {reach:.4g} mm; "
            "move it out with --camera",
            key="picture.camera",
        )
    row = picture.pixel_mm or float(np.ptp(points[:, 1])) / (picture.height * room) or 1.0
    # columns run to the right of who looks inwards, which is against the camera frame's sense with its y down
    step = -2 * np.pi / picture.width
    pose = about_axis((0.0, 1.0, 0.0), front) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    pose[:3, 3] = middle
    return CylindricalCamera(picture.width, picture.height, radius, step, row, down, -across * step), pose


def optics_of(settings: Settings, camera: Camera, middle_mm: float) -> Optics:
    """What the settings ask of lens and sensor, for a camera `middle_mm` before the object's middle."""
    picture, sensing, reasons = settings.picture, settings.sensor, []
    sensor = None
    if sensing.noise:
        sensor = Sensor(
            full_well=sensing.full_well,
            read_noise=sensing.read_noise,
            dark_electrons=sensing.dark_electrons,
            bits=sensing.bits,
            response=sensing.response,
            gamma=sensing.gamma,
        )
    if not isinstance(camera, PinholeCamera):
        return Optics(camera, camera, None, False, sensor)
    shift, used = camera.distortion_px(), camera
    if any(camera.distortion):
        if shift <= STRAIGHT_PX:
            used = replace(camera, distortion=())
            reasons.append(f"distortion: left out; it moves no pixel by more than {shift:.2g} of {STRAIGHT_PX:g} px")
        else:
            reasons.append(f"distortion: traced; it moves pixels by up to {shift:.3g} px")
    lens = None
    if picture.aperture_mm > 0:
        focus = picture.focus_mm or middle_mm
        rim = {} if picture.rim_mm is None else {"rim_mm": picture.rim_mm, "rim_distance_mm": picture.rim_distance_mm}
        lens = ThinLens(used, picture.aperture_mm, focus, picture.focal_length_mm, **rim)
    return Optics(used, camera, lens, picture.vignetting, sensor, tuple(reasons))


def take(tracer: Tracer, optics: Optics, pose: FloatArray, plan: Plan, seed: int) -> tuple[Film, list[str]]:
    """The picture by its plan, with defocus where it can be seen, and what was decided about it."""
    film = render_film(tracer, optics.camera, pose, plan=plan, seed=seed)
    lens = optics.lens
    if lens is None:
        return film, []
    blurred, widest = out_of_focus(tracer, lens, pose)
    share = float(blurred.mean())
    if not share:
        return film, [f"defocus: left out; no circle of confusion exceeds {SHARP_PX:g} px, the widest has {widest:.2g}"]
    work = tracer.grey() if plan.grey else tracer
    plain = film if not plan.grey else replace(film, radiance=film.radiance[..., :1], variance=film.variance[..., :1])
    made = defocus(work, plain, lens, pose, plan.settings, blurred, error=plan.error, seed=seed)
    channels = tracer.scene.channels
    if plan.grey:
        made = replace(made.in_channels(channels), budget=film.budget)
    return made, [
        f"defocus: traced in {100 * share:.1f} % of the pixels, where circles of confusion exceed {SHARP_PX:g} px; the widest has {widest:.3g}"
    ]


def out_of_focus(tracer: Tracer, lens: ThinLens, pose: FloatArray) -> tuple[BoolArray, float]:
    """(h, w) pixels that take part in a visible disc of confusion, and the widest disc, px."""
    depth = trace_maps(tracer.scene.surface, lens.camera, pose, tracer.caster, allow_inside=True).depth_mm
    circles = lens.circle_of_confusion_px(depth)
    widest = float(np.nanmax(circles)) if np.isfinite(circles).any() else 0.0
    return lens.defocused_pixels(depth), widest


def image_of(film: Film, optics: Optics) -> FloatArray:
    """(h, w, c) float32 radiance before the backdrop, darkened towards the corners where that is asked for."""
    behind, empty = (BACKDROP * (1 - film.coverage)).astype(film.radiance.dtype), film.coverage == 0
    image = np.empty_like(film.radiance)
    for c in range(image.shape[2]):
        # a lamp behind the object is hidden by the backdrop
        image[..., c] = np.where(empty, behind, film.radiance[..., c] + behind)
    falloff = optics.falloff()
    return image if falloff is None else (image * falloff[..., None]).astype(film.radiance.dtype)


def developed(image: FloatArray, exposure: float, optics: Optics, seed: int, frame: int = 0) -> npt.NDArray[Any]:
    """The picture (h, w) or (h, w, 3) of an image (h, w, c): sRGB of 8 bits, or what the sensor makes of it."""
    seen = image[..., 0] if image.shape[2] == 1 else image
    if optics.sensor is None:
        return develop(seen, exposure)
    sensor = replace(optics.sensor, electrons_per_unit=optics.sensor.full_well * exposure)
    return sensor.expose(seen.astype(np.float64), seed=seed, frame=frame)
