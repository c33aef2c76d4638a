"""The two verbs of the Python interface that take a word instead of a configuration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rangecheck.animation import orbit_around
from rangecheck.config import load_settings
from rangecheck.pipeline.job import run as run_job
from rangecheck.pipeline.outcome import Outcome
from rangecheck.pipeline.pictures import plan_of, scene_of
from rangecheck.pipeline.subject import Subject
from rangecheck.pipeline.views import camera_of, view_of
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material
from rangecheck.solid import Solid
from rangecheck.surface import Surface
from rangecheck.transport import Film, Tracer
from rangecheck.transport import render as render_film


def run(
    scans: str | Path | Sequence[str | Path], out: str | Path, *, unit: str | None = None, force: bool = False, preset: str | None = None,
    **settings: Any,
) -> Outcome:  # fmt: skip
    """The whole job of `rangecheck run`: scans in; in the folder `out` STL, turntables, maps, report.html and run.json.

    `settings` are those of the configuration, a double underscore for the dot: turntable__frames=12. `outcome.fit` is the verdict,
    `outcome.document` is run.json. Raises RangecheckError."""
    paths = [scans] if isinstance(scans, (str, Path)) else list(scans)
    resolved = load_settings(preset, (), {key.replace("__", "."): value for key, value in settings.items()})
    return run_job([str(path) for path in paths], str(out), settings=resolved, unit=unit, force=force, reporter=Reporter())


def render(
    what: Surface | Solid, material: str | Path | Material = "plaster", *, size: tuple[int, int] = (512, 512), azimuth_deg: float = 0.0,
    elevation_deg: float = 8.0, camera_mm: tuple[float, float, float] | None = None, tolerance_percent: float | None = None, seed: int = 0,
) -> Film:  # fmt: skip
    """A picture (linear radiance; shown as it is in a notebook) of a surface or solid in the studio that suits the material.

    The camera is at `camera_mm`, looking at the middle, or at an azimuth (0 is the front, +z) and elevation, as far away as shows
    everything. Without a tolerance only direct light and mirrors are followed; with one (per cent of the frame's mean radiance) as
    much light as that needs. Raises RangecheckError."""
    surface = what.surface if isinstance(what, Solid) else what
    chosen = material if isinstance(material, Material) else load_material(material)
    wanted: dict[str, Any] = {"picture.width": size[0], "picture.height": size[1], "seed": seed}
    if tolerance_percent is not None:
        wanted |= {"light.model": "plan", "light.tolerance_percent": tolerance_percent}
    settings = load_settings(None, (), wanted)
    subject = Subject("surface", surface)
    if camera_mm is not None:
        camera, pose = view_of(subject, settings, camera_mm)
    else:
        camera = camera_of(settings)
        orbit = orbit_around(
            surface, camera, frames=1, elevation_deg=elevation_deg, start_deg=azimuth_deg, margin=settings.turntable.margin
        )
        pose = orbit.world_from_camera(0)
    tracer = Tracer(scene_of(subject, chosen, direct=settings.light.model == "direct"))
    return render_film(tracer, camera, pose, plan=plan_of(tracer, camera, pose, settings), seed=seed)
