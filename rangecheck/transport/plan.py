"""Pictures by their plan: model no more than a scene needs. `planner` says how plans are found."""

from __future__ import annotations

from rangecheck.arrays import FloatArray
from rangecheck.errors import SettingError
from rangecheck.optics import Camera
from rangecheck.transport.adaptive import render_at_edges, render_to
from rangecheck.transport.even import render_evenly, with_lobe_forms
from rangecheck.transport.film import Film
from rangecheck.transport.halves import render_in_halves
from rangecheck.transport.planner import Planner
from rangecheck.transport.settings import FULL, REPORT, Plan
from rangecheck.transport.tracer import Tracer

#: default tolerance: half a percent of the frame's mean radiance
TOLERANCE = 0.005
MODELS = ("plan", "full", "report")

#: an error below this is measured by two pictures, where chance has a part; above, the least number of samples is the price
_MEASURED_BELOW = 0.006


def make_plan(
    tracer: Tracer,
    camera: Camera,
    world_from_camera: FloatArray,
    *,
    tolerance: float = TOLERANCE,
    model: str = "plan",
    seed: int = 0,
) -> Plan:
    """How to take this picture within `tolerance`. A plan serves other views of the same scene as well: an orbit needs one.

    model plan: as little as the tolerance allows; full: everything, at an error of a third of the tolerance; report: the 1991 report's
    own approximations, whatever their error. Raises SettingError."""
    if not 1e-5 <= tolerance <= 0.5:
        raise SettingError(f"tolerance is {tolerance}; it must lie between 0.00001 and 0.5 of the mean radiance", key="tolerance")
    if model not in MODELS:
        raise SettingError(f"model is {model!r}; there are {', '.join(MODELS)}", key="model")
    if model == "report":
        return Plan(model, tolerance, REPORT, None, reasons=_REPORT_REASONS)
    if model == "full":
        reason = f"everything is traced, {FULL.depth} reflections deep, until the noise is a third of the tolerance"
        return Plan(model, tolerance, FULL, tolerance / 3, reasons=(reason,))
    return Planner(tracer, tracer.picture_rays(camera, world_from_camera), tolerance, seed).plan()


def render(
    tracer: Tracer,
    camera: Camera,
    world_from_camera: FloatArray,
    *,
    plan: Plan | None = None,
    tolerance: float = TOLERANCE,
    seed: int = 0,
) -> Film:
    """The picture by its plan (made here unless given). Same bytes on any number of threads."""
    plan = plan or make_plan(tracer, camera, world_from_camera, tolerance=tolerance, seed=seed)
    work = with_lobe_forms(tracer.grey() if plan.grey else tracer, plan.forms)
    if plan.error is None and plan.settings.uneven:
        film = render_at_edges(work, camera, world_from_camera, plan.settings, seed=seed)
    elif plan.error is None:
        film = work.render(camera, world_from_camera, plan.settings, seed=seed)
    elif plan.model == "full":
        film = render_evenly(work, camera, world_from_camera, plan.settings, plan.error, seed=seed)
    elif plan.error < _MEASURED_BELOW and (plan.settings.by_chance or plan.settings.shadow_rays):
        film = render_in_halves(work, camera, world_from_camera, plan.settings, plan.error, seed=seed)
    else:
        film = render_to(work, camera, world_from_camera, plan.settings, plan.error, seed=seed)
    return film.in_channels(tracer.scene.channels) if plan.grey else film


_REPORT_REASONS = (
    "one ray through the middle of each pixel; sources seen in the mirror are looked for with the four corner rays",
    "shadows: one ray to the middle of each source",
    "lobe: the rings of (39), even and weighted by their solid angle, at the surface seen; there, light from sources only (26)",
    "diffuse interreflection: none (44)",
)
