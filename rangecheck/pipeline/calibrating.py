"""fit --calibrate: lamps from photographs of a chrome sphere, of a matt sphere, or of the bust itself, as a list that --lights takes.

On spheres directions are in the picture's own axes: x right, y up, z to the camera. On a bust they are in the axes of its mesh.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError, SceneError, SettingError
from rangecheck.files import write_bytes
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import hashes
from rangecheck.recover.fit import Fitted

if TYPE_CHECKING:
    from rangecheck.recover.spheres import Outline

KINDS = ("chrome", "matt", "bust")
#: share of outliers from which pictures count as not explained
_UNEXPLAINED = 0.25


def check_kind(kind: str, sphere: Any, model: Any, same_strength: bool) -> None:
    """Raises SettingError unless what lamps are to be found on is named."""
    if kind == "bust" and model is None:
        raise SettingError("lamps are calibrated on a bust; add --on MESH and --camera X,Y,Z", key="calibrate")
    if kind != "bust" and sphere is None:
        raise SettingError("lamps are calibrated on a sphere; add --sphere COLUMN,ROW,RADIUS", key="calibrate")
    if kind == "chrome" and same_strength:
        raise SettingError("a chrome sphere shows directions, no strengths; leave --same-strength out", key="same_strength")


def on_sphere(
    pictures: Sequence[str], values: list[FloatArray], sphere: tuple[float, float, float], kind: str, out: str | None, force: bool,
    same_strength: bool,
) -> Outcome:  # fmt: skip
    """Lamps found on pictures of a chrome or matt sphere (column, row, radius in pixels), seen from far away: x right, y up, z to the camera."""
    from rangecheck.recover.matt import lights_from_matt
    from rangecheck.recover.matt_ball import PAINTED
    from rangecheck.recover.spheres import Outline

    outline = Outline((sphere[0], sphere[1]), sphere[2])
    more: dict[str, Any] = {}
    lines: list[str] = []
    if kind == "chrome":
        directions = np.array([_by_chrome(p, v, outline) for p, v in zip(pictures, values)])
    else:
        try:
            found = lights_from_matt(values, outline, same_strength=same_strength)
        except SceneError as refusal:
            if "picture" in refusal.measured:
                raise InputError(pictures[refusal.measured["picture"]], str(refusal), **refusal.measured) from None
            raise
        directions = found.directions
        more = {"gains": found.gains, "slope": found.slope, "gloss": found.surface.gloss, "paint": found.spread, "rms": found.rms,
                "apart": found.apart, "uneven": found.uneven, "closeness": found.closeness}  # fmt: skip
        lines.append(
            f"one matt surface of slope {math.degrees(math.atan(found.slope)):.1f} degrees, its albedo varying by {100 * found.spread:.1f} % from pixel to pixel; "
            f"residual {100 * found.rms:.2f} % of full scale"
        )
        if len(values) < PAINTED:
            lines.append(f"fewer than {PAINTED} pictures do not tell stains and uneven beams from the lamps' directions")
        else:
            worst = int(np.argmax(np.hypot(*found.uneven.T)))
            lines.append(
                f"the beams are not even across the ball: {three(found.uneven[worst], 2)} to the right and up over a radius in {Path(pictures[worst]).name}, the most"
            )
        if same_strength:
            lines.append(
                f"each picture alone would have its lamp's strength differ by at most {100 * np.abs(found.apart).max():.2f} %"
            )
    _write(directions, out, force)
    gains = more.get("gains")
    lines += [
        f"{Path(p).name}: towards {three(d)}" + ("" if gains is None else f", gain {gains[k]:.4f}")
        for k, (p, d) in enumerate(zip(pictures, directions))
    ]
    return Outcome(document("lights", kind=kind, directions=directions, inputs=hashes(list(pictures)), **more), lines)


def _by_chrome(path: str, picture: FloatArray, outline: Outline) -> FloatArray:
    """(3,) the lamp of one picture of a chrome sphere. Raises InputError where it shows none."""
    from rangecheck.recover.spheres import light_from_chrome

    try:
        return light_from_chrome(picture, outline)
    except SceneError as refusal:
        raise InputError(path, str(refusal), **refusal.measured) from None


def on_bust(fitted: Fitted, pictures: Sequence[str], out: str | None, force: bool, seconds: dict[str, float]) -> Outcome:
    """The lamps of a fit to pictures of a bust: directions from its middle, in its own axes, and how well they are known."""
    lamps = fitted.problem.lights
    directions = np.array([light.direction for light in lamps])
    within = [within_deg(fitted, k) for k in range(len(lamps))]
    lost = [Path(p).name for p, w in zip(pictures, within) if w is None]
    if lost:
        raise SceneError(
            f"the bust does not show where the lamp of {', '.join(lost)} stands; leave the picture out, or give --lights near it"
        )
    strengths = np.array([light.irradiance for light in lamps])
    _write(directions, out, force)
    unexplained = said_of_outliers(fitted)
    lines = [
        f"residuals are {fitted.scale:.2f} times the noise, {100 * fitted.outliers:.1f} % of the pixels are outliers",
        *unexplained,
    ]
    lines += [
        f"{Path(p).name}: towards {three(d)}, within {w:.2g} degrees (95 %), strength {s / strengths[0]:.4f} of the first"
        for p, d, w, s in zip(pictures, directions, within, strengths)
    ]
    if not fitted.converged:
        lines.append("the fit did not settle; give better guesses of the lights, or more pictures")
    content = document(
        "lights", kind="bust", directions=directions, inputs=hashes(list(pictures)), within_deg=within, strengths=strengths / strengths[0],
        residual_in_noises=fitted.scale, converged=fitted.converged, fit=not unexplained, seconds=seconds,
    )  # fmt: skip
    return Outcome(content, lines, not unexplained)


def said_of_outliers(fitted: Fitted) -> list[str]:
    """That the pictures are not explained, where so many pixels are outliers that those left may be the wrong ones."""
    if fitted.outliers < _UNEXPLAINED:
        return []
    return [
        f"the pictures are not explained: {100 * fitted.outliers:.0f} % of the pixels show something else than this shape does under such lamps, the others by "
        f"{fitted.scale:.1f} times the noise; check what was given of the shape, the camera and the lamps (--on or --sphere, --camera, --field, --lights, or "
        "--find pose), --response, and --noise"
    ]


def within_deg(fitted: Fitted, k: int) -> float | None:
    """How well a lamp's direction is known, degrees: the larger half width of its two intervals; None where it is not determined."""
    pair = [e for e in fitted.estimates if e.name.startswith(f"light {k} direction")]
    widths = [0.5 * (e.high - e.low) for e in pair if e.low is not None and e.high is not None]
    return math.degrees(max(widths)) if pair and len(widths) == len(pair) else None


def three(vector: FloatArray, digits: int = 4) -> str:
    """A vector in words."""
    return ", ".join(f"{v:.{digits}f}" for v in vector)


def _write(directions: FloatArray, out: str | None, force: bool) -> None:
    """The list of lights as --lights takes it: their number, then x y z, one lamp a line."""
    if out is not None:
        text = "".join(f"{' '.join(f'{v:.6f}' for v in d)}\n" for d in directions)
        write_bytes(out, f"{len(directions)}\n{text}".encode(), force=force)
