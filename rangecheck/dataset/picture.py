"""One picture and its truth.

The picture is what a noisy sensor of 8 bits, linear, made of the radiance; the truth holds that radiance without noise, and every map of
the same camera. What a camera does to light and what maps say of geometry come from the same rays through the pixels' middles.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.dataset.index import regions
from rangecheck.dataset.ranges import Sample
from rangecheck.export.map_files import arrays_of
from rangecheck.export.pictures import exposure_from, png_bytes
from rangecheck.maps import Maps, trace_chain, trace_maps, trace_shadows
from rangecheck.maps.secondary import NormalsAt
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.reflectance import Material
from rangecheck.scene import Scene, Source, gradient
from rangecheck.transport import Settings as LightSettings
from rangecheck.transport import Tracer

#: sources are this many extents away from the object's middle
AWAY = 2.5
#: rays of each pixel
RAYS = 4
BITS = 8


@dataclass(frozen=True)
class Made:
    """The files of one picture and its row of the index."""

    row: dict[str, Any]
    picture: bytes
    truth: bytes


def view(sample: Sample, scene: Scene, width: int, height: int) -> tuple[PinholeCamera, FloatArray]:
    """The camera and its pose: the object's bounding sphere fills `fill` of the frame's shorter side."""
    low, high = scene.surface.bounds_mm
    middle, radius = 0.5 * (low + high), 0.5 * scene.surface.extent_mm
    camera = PinholeCamera.from_field_of_view(width, height, sample.field_of_view_deg)
    half = math.atan(0.5 * min(width, height) / camera.fx) * sample.fill
    distance = radius / math.sin(min(half, 1.5))
    eye = middle + distance * _towards(sample.azimuth_deg, sample.elevation_deg)
    right, up = _across(sample.azimuth_deg, sample.elevation_deg)
    target = middle + 2 * radius * (sample.aside[0] * right + sample.aside[1] * up)
    pose = rigid.look_at(eye, target)
    return camera, pose @ rigid.about_axis((0, 0, 1), math.radians(sample.roll_deg))


def _towards(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.array([math.sin(azimuth) * level, math.sin(elevation), math.cos(azimuth) * level])


def _across(azimuth_deg: float, elevation_deg: float) -> tuple[FloatArray, FloatArray]:
    ahead = _towards(azimuth_deg, elevation_deg)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return right, np.cross(ahead, right)


def lit(scene: Scene, sample: Sample, material: Material) -> Scene:
    """The scene under the sample's lights; parts that share the scene's first material get the sample's."""
    middle, away = scene.surface.bounds_mm.mean(axis=0), AWAY * scene.surface.extent_mm
    sources = tuple(
        Source.giving(
            lamp.irradiance * math.pi,
            middle,
            middle + away * _towards(sample.azimuth_deg + lamp.azimuth_deg, lamp.elevation_deg),
            lamp.radius_deg,
        )
        for lamp in sample.lamps
    )
    first = material.at(scene.materials[0].wavelengths_um)
    if not material.strengths()[1:].any():
        first = replace(first, K_lm=sample.albedo)
    return replace(
        scene, materials=(first, *scene.materials[1:]), sources=sources, surroundings=gradient(sample.below, sample.above)
    )


def make_picture(
    tracer: Tracer,
    sample: Sample,
    material: Material,
    index: int,
    size: tuple[int, int],
    seed: int,
    normals: NormalsAt | None = None,
) -> Made:
    """Picture `index` of the scene of `tracer` with the sample's camera, light, material and sensor. Same bytes on any machine."""
    scene = lit(tracer.scene, sample, material)
    camera, pose = view(sample, scene, *size)
    work = tracer.lit_as(scene)
    grey = scene.channels > 1 and not any(m.index_um for m in scene.materials)
    mirrors = any(bool(m.strengths()[1:].any()) for m in scene.materials)
    settings = LightSettings(
        passes=1, each=RAYS, spike=mirrors, lobe=mirrors, diffuse=False, depth=2 if mirrors else 1, backdrop=False,
    )  # fmt: skip
    film = (work.grey() if grey else work).render(camera, pose, settings, seed=seed + index)
    radiance = film.radiance[..., 0] if film.radiance.shape[2] == 1 else film.radiance
    maps = trace_maps(scene.surface, camera, pose, tracer.caster, allow_inside=True)
    exposure = exposure_from([radiance]) * 2.0**sample.exposure_stops
    sensor = Sensor(
        electrons_per_unit=sample.full_well * exposure, full_well=sample.full_well, read_noise=sample.read_noise, bits=BITS
    )
    picture = sensor.expose(radiance.astype(np.float64), seed=seed, frame=index)
    truth = _truth(scene, maps, radiance, film.coverage, tracer, normals)
    names = scene.surface.part_names
    row = {
        "index": index,
        "picture": f"pictures/{index:06d}.png",
        "truth": f"truth/{index:06d}.npz",
        "width": camera.width,
        "height": camera.height,
        "camera": camera.to_dict(),
        "world_from_camera": pose.tolist(),
        "exposure": exposure,
        "sensor": {"full_well": sample.full_well, "read_noise": sample.read_noise, "bits": BITS, "response": "linear"},
        "sources": [
            {"centre_mm": s.centre_mm.tolist(), "radius_mm": s.radius_mm, "radiance": s.radiance.tolist()} for s in scene.sources
        ],
        "parameters": sample.to_dict(),
        "seed": seed,
        "regions": regions(maps.part_id, names),
    }
    return Made(row, png_bytes(picture), truth)


def _truth(
    scene: Scene, maps: Maps, radiance: FloatArray, coverage: FloatArray, tracer: Tracer, normals: NormalsAt | None
) -> bytes:
    """NPZ of every map: distance_mm, depth_mm float64, normals, incidence_rad, part_id, face, secondary_id, shadows (k, h, w), radiance,
    coverage."""
    chain = trace_chain(scene.surface, maps, tracer.caster, normals=normals)
    arrays = arrays_of(maps) | {
        "secondary_id": chain.secondary_id,
        "radiance": radiance,
        "coverage": coverage,
    }
    if scene.sources:
        lamps = np.array([(*s.centre_mm, 1.0) for s in scene.sources])
        arrays["shadows"] = trace_shadows(scene.surface, maps, lamps, tracer.caster, normals=normals).state
    else:
        arrays["shadows"] = np.zeros((0, *maps.face.shape), np.uint8)
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return stream.getvalue()
