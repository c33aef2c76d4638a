"""How light gets from the sources to the camera: the radiometric recursion, its stages, the film, and the plan."""

from rangecheck.transport.adaptive import render_to
from rangecheck.transport.film import Film, image_irradiance
from rangecheck.transport.plan import MODELS, TOLERANCE, make_plan, render
from rangecheck.transport.settings import DIRECT, REPORT, Plan, Settings
from rangecheck.transport.tracer import Tracer
from rangecheck.transport.tracers import Tracers

__all__ = [
    "DIRECT",
    "MODELS",
    "REPORT",
    "TOLERANCE",
    "Film",
    "Plan",
    "Settings",
    "Tracer",
    "Tracers",
    "image_irradiance",
    "make_plan",
    "render",
    "render_to",
]
