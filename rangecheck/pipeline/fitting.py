"""fit: photographs of a known shape to a material, lamps, and what the pictures cannot determine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError, SettingError
from rangecheck.files import read_bytes, write_bytes
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import hashes, read_subject
from rangecheck.progress import Reporter
from rangecheck.recover.fit import Fitted
from rangecheck.recover.lights import Light
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.recover.sight import Sight, lit_by, see, sphere_sight

#: cosines below which a pixel is left out: grazing views, where the model's bound and the shape's own errors count
_LEAST_COSINE = 0.3
_FAR = 1e4
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm")


def fit(
    pictures: Sequence[str], out: str | None, *, settings: Any, unit: str | None, sphere: tuple[float, float, float] | None, model: str | None,
    camera_mm: tuple[float, ...] | None, field_deg: float, lights: str | None, calibrate: str | None, response: str, noise: float,
    spike: bool, scale_mm: float | None, irradiance: float, force: bool, reporter: Reporter,
) -> Outcome:  # fmt: skip
    """Material and lamps from `pictures`, one lamp each, of a `sphere` (column, row, radius: parallel view) or a `model` seen from
    `camera_mm`; or, with neither, of a scan's brightness on its own surface, and where the two contradict each other.
    `calibrate` (chrome or matt) finds the lamps of sphere pictures alone."""
    if sphere is None and model is None and len(pictures) == 1 and Path(pictures[0]).suffix.lower() not in _PICTURES:
        from rangecheck.pipeline.explained import fit_scan

        return fit_scan(pictures[0], out, response=response, unit=unit, scale_mm=scale_mm, force=force, reporter=reporter)
    if (sphere is None) == (model is None):
        raise SettingError("name what the pictures show: --sphere COLUMN,ROW,RADIUS or --on MESH", key="sphere")
    with reporter.stage("reading pictures"):
        values = [_linear(Path(p), response) for p in pictures]
    if len({v.shape for v in values}) > 1:
        raise InputError(pictures[0], "has another size than the other pictures; give pictures of one size")
    if calibrate is not None:
        if sphere is None:
            raise SettingError("lamps are calibrated on a sphere; add --sphere COLUMN,ROW,RADIUS", key="calibrate")
        return _calibrated(pictures, values, sphere, calibrate, out, force)
    if out is None:
        raise SettingError("name the material file: -o FILE.toml", key="out")
    given = None if lights is None else _directions(Path(lights), len(pictures))
    shape = (values[0].shape[0], values[0].shape[1])
    if sphere is not None:
        sight, caster = sphere_sight(sphere[:2], sphere[2], shape), None
    else:
        sight, caster = _model_sight(str(model), shape, camera_mm, field_deg, settings, unit, reporter)
    sight = sight.only((sight.normals * sight.views).sum(1) > _LEAST_COSINE)
    middle = sight.points.mean(axis=0)
    distance = _FAR * max(float(np.ptp(sight.points, axis=0).max()), 1e-6)
    begun = given if given is not None else _first_directions(sight, values)
    lamps = tuple(Light(d, irradiance, middle, distance, 0.25) for d in begun)
    photos = []
    for k, picture in enumerate(values):
        seen = picture.reshape(-1)[sight.pixel]
        lit = np.ones((len(sight), 1), bool) if caster is None else lit_by(sight, (lamps[k],), caster)
        photos.append(Photograph(sight, seen, np.full(len(seen), noise), lit, (k,)))
    names = (
        ("K_lm", "K_spike", "K_lobe", "sigma_um", "correlation_um") if spike else ("K_lm", "K_lobe", "sigma_um", "correlation_um")
    )
    problem = Problem(tuple(photos), lamps, Guess(), Unknowns(names))
    from rangecheck.recover.fit import fit as solve

    with reporter.stage("fitting"):
        fitted = solve(problem, known_noise=False)
    return _told(fitted, out, pictures, force, reporter)


def _told(fitted: Fitted, out: str, pictures: Sequence[str], force: bool, reporter: Reporter) -> Outcome:
    from rangecheck.recover.outcome import material_of, material_toml

    material = material_of(fitted, Path(out).stem)
    names = ", ".join(Path(p).name for p in pictures)
    write_bytes(out, material_toml(material, fitted, f"fitted to {names}").encode(), force=force)
    lines = [f"{out}: residuals are {fitted.scale:.2f} times the noise, {fitted.outliers:.1%} of the pixels are outliers"]
    lines += [_line(e.name, e.value, e.low, e.high) for e in fitted.estimates if not e.name.startswith("light")]
    lamps = [light.direction for light in fitted.problem.lights]
    lines += [f"  light {k}: towards {_three(d)}" for k, d in enumerate(lamps)]
    lines += [f"not determined: {said}" for said in fitted.statements]
    if not fitted.converged:
        lines.append("the fit did not settle; give better guesses of the lights, or more pictures")
    content = document(
        "fit", output=out, estimates=[vars(e) for e in fitted.estimates], lights=lamps, not_determined=fitted.statements,
        residual_in_noises=fitted.scale, rms=fitted.rms, outliers=fitted.outliers, converged=fitted.converged,
        inputs=hashes(list(pictures)), seconds=reporter.seconds,
    )  # fmt: skip
    return Outcome(content, lines)


def _line(name: str, value: float, low: float | None, high: float | None) -> str:
    return f"  {name:<16} {value:.4g}  " + (
        "not determined" if low is None or high is None else f"{low:.4g} to {high:.4g} (95 %)"
    )


def _three(direction: FloatArray) -> str:
    return ", ".join(f"{v:.4f}" for v in direction)


def _linear(path: Path, response: str) -> FloatArray:
    """A grey picture as parts of full scale, linear in light."""
    from rangecheck.scan.decode.capture import read_grey

    raw = read_grey(path)
    bits = 8 * raw.dtype.itemsize
    return np.asarray(Sensor(bits=bits, response=response).linearise(raw))


def _directions(path: Path, count: int) -> FloatArray:
    """(count, 3) directions in a text file, one a line; a first line with the count alone is skipped."""
    try:
        rows = [[float(v) for v in line.split()] for line in read_bytes(path).decode().splitlines() if line.strip()]
    except (UnicodeDecodeError, ValueError) as error:
        raise InputError(path, f"is not a list of directions ({error}); write x y z, one lamp a line") from None
    rows = [row for row in rows if len(row) != 1]
    if any(len(row) != 3 for row in rows) or len(rows) != count:
        raise InputError(path, f"holds {len(rows)} directions for {count} pictures; write x y z for each, in order")
    return np.array(rows)


def _first_directions(sight: Sight, values: Sequence[FloatArray]) -> FloatArray:
    """Where the lamps stand if the surface were matt: linear least squares over the brighter half of each picture."""
    found = []
    for picture in values:
        seen = picture.reshape(-1)[sight.pixel]
        used = seen > 0.4 * np.quantile(seen, 0.9)
        found.append(np.linalg.lstsq(sight.normals[used], seen[used], rcond=None)[0])
    return np.array([f / max(float(np.linalg.norm(f)), 1e-12) for f in found])


def _model_sight(
    model: str, shape: tuple[int, int], camera_mm: tuple[float, ...] | None, field_deg: float, settings: Any, unit: str | None, reporter: Reporter
) -> tuple[Sight, Any]:  # fmt: skip
    from rangecheck.raycast import EmbreeCaster
    from rangecheck.reflectance import Material
    from rangecheck.scene import Scene

    if camera_mm is None:
        raise SettingError("say where the camera stood: --camera X,Y,Z in mm; it looks at the middle of the object", key="camera")
    surface = read_subject(model, settings, unit, reporter).surface
    scene = Scene(surface, (Material("grey", K_lm=0.5, wavelengths_um=(0.555,)),), smooth=True)
    caster = EmbreeCaster(surface.vertices, surface.faces)
    camera = PinholeCamera.from_field_of_view(shape[1], shape[0], field_deg)
    return see(scene, camera, rigid.look_at(camera_mm, surface.bounds_mm.mean(axis=0)), caster), caster


def _calibrated(
    pictures: Sequence[str], values: list[FloatArray], sphere: tuple[float, float, float], kind: str, out: str | None, force: bool
) -> Outcome:
    from rangecheck.recover.matt import lights_from_matt
    from rangecheck.recover.spheres import Outline, light_from_chrome

    outline = Outline((sphere[0], sphere[1]), sphere[2])
    more: dict[str, Any] = {}
    lines: list[str] = []
    if kind == "chrome":
        directions = np.array([light_from_chrome(v, outline) for v in values])
    else:
        found = lights_from_matt(values, outline)
        directions = found.directions
        more = {"gains": found.gains, "slope": found.slope, "paint": found.spread, "rms": found.rms}
        lines.append(
            f"one matt surface of slope {math.degrees(math.atan(found.slope)):.1f} degrees, its albedo varying by {found.spread:.1%} from pixel to pixel; "
            f"residual {found.rms:.2%} of full scale"
        )
    text = "".join(f"{' '.join(f'{v:.6f}' for v in d)}\n" for d in directions)
    if out is not None:
        write_bytes(out, f"{len(directions)}\n{text}".encode(), force=force)
    gains = more.get("gains")
    lines += [
        f"{Path(p).name}: towards {_three(d)}" + ("" if gains is None else f", gain {gains[k]:.4f}")
        for k, (p, d) in enumerate(zip(pictures, directions))
    ]
    return Outcome(document("lights", kind=kind, directions=directions, inputs=hashes(list(pictures)), **more), lines)
