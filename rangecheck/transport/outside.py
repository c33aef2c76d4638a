"""The one adapter of Mitsuba 3, an independent renderer: the same scene, for comparison only.

Jakob et al., *Mitsuba 3*, 2022. Its scalar variant needs nothing beside itself. Its camera looks along +z with x to the left and y up;
its pixels are averaged over their area (box filter). Its rough conductor with Beckmann's distribution, alpha = 2 sigma/T and Smith's
masking is our lobe in the rough limit. Sources must not reflect, as ours do not.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import DependencyMissing, SceneError
from rangecheck.optics import PinholeCamera
from rangecheck.reflectance import Material
from rangecheck.scene import Scene
from rangecheck.scene.surroundings import CONSTANT


class OutsideRenderer:
    """Mitsuba's picture of one scene from one camera; radiance (h, w, 3) float64, or (h, w, 1) of a
    monochrome variant. Raises DependencyMissing, SceneError."""

    def __init__(
        self, scene: Scene, camera: PinholeCamera, world_from_camera: FloatArray, *, depth: int,
        variant: str = "scalar_rgb", sampler: str = "independent",
    ) -> None:  # fmt: skip
        try:
            import mitsuba
        except ImportError:
            raise DependencyMissing(
                "mitsuba", "comparison with an outside renderer", "pip install 'rangecheck[compare]'"
            ) from None
        mitsuba.set_variant(variant)
        mitsuba.set_log_level(mitsuba.LogLevel.Error)
        self._mitsuba, self._variant, self._sampler = mitsuba, variant, sampler
        with tempfile.TemporaryDirectory() as folder:
            self._scene = mitsuba.load_dict(self._described(scene, camera, world_from_camera, depth, Path(folder)))

    def render(self, samples: int, seed: int = 0) -> FloatArray:
        """With `samples` per pixel; pictures of different seeds are independent."""
        # the variant is Mitsuba's global state; another renderer may have changed it
        self._mitsuba.set_variant(self._variant)
        return np.asarray(self._mitsuba.render(self._scene, spp=samples, seed=seed), dtype=np.float64)[..., :3]

    def _described(
        self, scene: Scene, camera: PinholeCamera, world_from_camera: FloatArray, depth: int, folder: Path
    ) -> dict[str, Any]:
        transform = self._mitsuba.ScalarTransform4f
        described: dict[str, Any] = {
            "type": "scene",
            # its depth counts segments: one more than reflections
            "integrator": {"type": "path", "max_depth": depth + 1, "rr_depth": 1000},
            "sensor": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": 2 * math.degrees(math.atan(0.5 * camera.width / camera.fx)),
                "near_clip": 1e-3,
                "far_clip": 1e7,
                "to_world": transform((world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])).tolist()),
                "film": {
                    "type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
                    "component_format": "float32",
                },
                "sampler": {"type": self._sampler},
            },
        }  # fmt: skip
        for k, source in enumerate(scene.sources):
            described[f"source_{k}"] = {
                "type": "sphere",
                "center": source.centre_mm.tolist(),
                "radius": source.radius_mm,
                "bsdf": {"type": "diffuse", "reflectance": _colour(np.zeros(1))},
                "emitter": {"type": "area", "radiance": _colour(source.radiance)},
            }
        if scene.surroundings.kind != CONSTANT or scene.surroundings.boxes:
            raise SceneError("only constant surroundings can be handed to Mitsuba")
        if scene.surroundings.low.any():
            described["surroundings"] = {"type": "constant", "radiance": _colour(scene.surroundings.low)}
        for index, material in enumerate(scene.materials):
            chosen = np.flatnonzero(scene.material_of_face == index)
            if len(chosen):
                path = folder / f"part_{index}.ply"
                _write_ply(path, scene, chosen)
                described[f"part_{index}"] = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": _bsdf(material)}
        return described


def outside_variants() -> list[tuple[str, str]]:
    """(variant, sampler) that are worth using here: those compiled by LLVM where its library loads, else the scalar one, half as fast.

    The library is tried in another process, for one of a wrong version ends the process that it is loaded into."""
    tried = "import mitsuba; mitsuba.set_variant('llvm_ad_mono'); import drjit; print(float(drjit.llvm.ad.Float(2)[0] * 2))"
    try:
        proof = subprocess.run([sys.executable, "-c", tried], capture_output=True, text=True, timeout=120, check=False).stdout
    except (OSError, subprocess.TimeoutExpired):
        proof = ""
    if proof.strip() == "4.0":
        return [("llvm_ad_mono", "independent"), ("llvm_ad_mono", "multijitter")]
    return [("scalar_rgb", "independent")]


def _colour(values: FloatArray) -> dict[str, Any]:
    return {"type": "rgb", "value": np.broadcast_to(values, 3).tolist()}


def _bsdf(material: Material) -> dict[str, Any]:
    diffuse, spike, lobe, both = material.strengths()
    if spike.any() or (lobe.any() and both.any()):
        raise SceneError(f"{material.name} has a spike of its own, which Mitsuba does not know")
    if not (lobe + both).any():
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _colour(diffuse)}}
    if diffuse.any() or material.index_um or material.masking != "smith" or material.bounded:
        raise SceneError(
            f"{material.name} must be a perfect conductor's rough lobe alone, Smith masked and unbounded, to be compared"
        )
    return {
        "type": "twosided",
        "bsdf": {
            "type": "roughconductor",
            "distribution": "beckmann",
            "alpha": 2 * material.sigma_um / material.correlation_um,
            "material": "none",
            "specular_reflectance": _colour(lobe + both),
        },
    }


def _write_ply(path: Path, scene: Scene, faces: Any) -> None:
    import trimesh

    part = scene.surface.with_faces(faces)
    path.write_bytes(trimesh.Trimesh(part.vertices, part.faces, process=False).export(file_type="ply"))
