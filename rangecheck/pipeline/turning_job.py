"""What a turntable's frames are made of, what each is known by, and what people are shown of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rangecheck import __version__
from rangecheck.animation import Orbit
from rangecheck.arrays import FloatArray
from rangecheck.export import legend
from rangecheck.export.exr import exr_bytes, radiance_channels
from rangecheck.export.pictures import exposure_from, png_bytes
from rangecheck.maps import trace_maps
from rangecheck.pipeline.camera import Optics, developed, image_of, take
from rangecheck.raycast import EmbreeCaster
from rangecheck.scene import Scene
from rangecheck.transport import Plan, Tracer

Show = Literal["picture", "stripes", "distance", "id"]


@dataclass(frozen=True, eq=False)
class Job:
    """Everything that determines a turntable's frames; it travels to other machines as it is. Maps need no plan."""

    scene: Scene
    show: Show
    lights: Literal["model", "room"]
    optics: Optics
    orbit: Orbit
    plan: Plan | None
    seed: int

    def key(self) -> dict[str, Any]:
        """What the frames are known by: the same on every machine, another as soon as anything that shows is another."""
        light = (
            {} if self.plan is None else {"plan": (self.plan.settings, self.plan.error, self.plan.grey), "lights": self.lights}
        )
        return {
            "version": __version__,
            "show": self.show,
            "optics": _plain(dataclasses.replace(self.optics, reasons=())),
            "orbit": _plain(self.orbit),
            "surface": (self.scene.surface.vertices, self.scene.surface.faces, self.scene.surface.part_of_face),
            "scene": {
                f.name: _plain(getattr(self.scene, f.name))
                for f in dataclasses.fields(self.scene)
                if light and f.name != "surface"
            },
            "light": _plain(light),
            "seed": self.seed,
        }

    def scale_mm(self) -> tuple[float, float]:
        """Distances that no frame's map leaves."""
        away = np.linalg.norm(self.scene.surface.vertices - np.asarray(self.orbit.centre_mm), axis=1).max()
        return self.orbit.distance_mm - float(away), self.orbit.distance_mm + float(away)


def _plain(value: Any) -> Any:
    """Nests of dataclasses as nests of what keys are made of."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"is": type(value).__name__} | {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value


def frames_of(job: Job, tracer: Tracer | None = None) -> Callable[[int], FloatArray]:
    """The function of frame numbers that `job` describes; frame i is the same wherever and whenever it is made."""
    if job.plan is None:
        return _maps_of(job)
    plan = job.plan
    ready = tracer if tracer is not None else Tracer(job.scene)
    if plan.grey:
        ready, plan = ready.grey(), dataclasses.replace(plan, grey=False)

    def frame(index: int) -> FloatArray:
        work = ready
        if job.lights == "room":
            work = ready.lit_as(ready.scene.lights_moved(job.orbit.world_from_turned(index)))
        film, _ = take(work, job.optics, job.orbit.world_from_camera(index), plan, job.seed + index)
        return image_of(film, job.optics)

    return frame


def _maps_of(job: Job) -> Callable[[int], FloatArray]:
    surface = job.scene.surface
    caster = EmbreeCaster(surface.vertices, surface.faces)

    def frame(index: int) -> FloatArray:
        pose = job.orbit.world_from_camera(index)
        maps = trace_maps(surface, job.optics.camera, pose, caster, allow_inside=index > 0)
        return maps.distance_mm if job.show == "distance" else np.where(maps.hit, maps.part_id, np.nan)

    return frame


def picture_of(job: Job, image: FloatArray, exposure: float, index: int) -> npt.NDArray[Any]:
    """What people are shown of a frame."""
    if job.show == "distance":
        low, high = job.scale_mm()
        shown = legend.colours_of(image, low, high)
        return legend.framed(shown, "Distance from the focal point", scale=legend.ColourScale(low, high, "mm"))
    if job.show == "id":
        names = job.scene.surface.part_names
        colours = np.concatenate([np.array([legend.NOTHING], np.uint8), legend.category_colours(len(names))])
        words = tuple(f"{k + 1}  {name}" for k, name in enumerate(names))
        return legend.framed(
            colours[np.nan_to_num(image).astype(int)], "Surface seen first", scale=legend.Swatches(colours[1:], words)
        )
    return developed(image, exposure, job.optics, job.seed, index)


def encoded(job: Job, suffix: str) -> Callable[[FloatArray, float, int], bytes]:
    """The function of a frame's image, exposure and number that gives the bytes of its file, .png or .exr."""

    def encode(image: FloatArray, exposure: float, index: int) -> bytes:
        if suffix == ".png":
            return png_bytes(picture_of(job, image, exposure, index))
        if job.show == "distance":
            return exr_bytes({"distance_mm": image})
        if job.show == "id":
            return exr_bytes({"part_id": np.nan_to_num(image).astype(np.int64)})
        return exr_bytes(radiance_channels(image[..., 0] if image.shape[2] == 1 else image))

    return encode


def exposure_of(images: Sequence[FloatArray]) -> float:
    """One exposure for images (h, w, c) of one or three wavelengths."""
    return exposure_from([image[..., 0] if image.shape[2] == 1 else image for image in images])
