"""fit: photographs of a known shape to a material, lamps, and what the pictures cannot determine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError, SceneError, SettingError
from rangecheck.files import read_bytes, write_bytes
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.pipeline.calibrating import check_kind, on_bust, on_sphere, said_of_outliers, three, within_deg
from rangecheck.pipeline.fitting_scene import SceneSimulator, faces_of, field_of, lamps_of, own_material, scene_looked_at
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import Subject, hashes, read_subject
from rangecheck.progress import Reporter
from rangecheck.raycast import EmbreeCaster
from rangecheck.recover.fit import Estimate, Fitted
from rangecheck.recover.lights import ONE_NODE, SEVEN_NODES, Light
from rangecheck.recover.looks import CameraFound, Look, facing, fit_looking, photographs
from rangecheck.recover.problem import Guess, Problem, Unknowns
from rangecheck.recover.sight import Sight, sphere_sight
from rangecheck.recover.simulated import exposed, fit_simulated
from rangecheck.reflectance import Material
from rangecheck.scene import Scene

_FAR = 1e4
#: a distance that is looked for begins at this many sizes of the object
_NEAR = 5.0
#: of a camera and of lamps of which nothing is said
_FIELD_DEG, _IRRADIANCE, _RADIUS_DEG = 30.0, 3.0, 0.25
_UNITS = {"radius": " degrees", "distance": " mm", "sigma_um": " um", "correlation_um": " um"}
_FREED = {"strength": "irradiance"}
#: what `lights` may say instead of a file: as `render` lights what has no lamps
STUDIO = "studio"
#: in units of its noise, what some pixel of a picture that is not dark shows;  pixels below saturation that a picture needs
_LEAST_LIGHT, _LEAST_COUNTED = 5.0, 10
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm")


def fit(
    pictures: Sequence[str], out: str | None, *, settings: Any, unit: str | None, sphere: tuple[float, float, float] | None, model: str | None,
    camera_mm: tuple[float, ...] | None, field_deg: float | None, lights: str | None, calibrate: str | None, response: str, noise: float,
    spike: bool, scale_mm: float | None, irradiance: float | None, force: bool, reporter: Reporter, find: Sequence[str] = (),
    lamp_distance_mm: float | None = None, lamp_radius_deg: float | None = None, same_strength: bool = False,
    part: str | None = None,
) -> Outcome:  # fmt: skip
    """Material and lamps from `pictures`, one lamp each, of a `sphere` (column, row, radius: parallel view) or a `model` seen from
    `camera_mm`; or, with neither, of a scan's brightness on its own surface, and where the two contradict each other.
    `calibrate` finds the lamps alone, on a chrome or matt sphere, or on the `model` itself (bust). `find`: what else is unknown, of pose, exposure, strength, distance, radius,
    ambient; `lamp_distance_mm` and `lamp_radius_deg` are where the lamps' begin.
    Of a modelled scene `part` is looked for; its camera and lamps are known from its file where neither `camera_mm` nor `lights` says otherwise; `lights`
    studio: those in which `render` shows what has none of its own."""
    if sphere is None and model is None and len(pictures) == 1 and Path(pictures[0]).suffix.lower() not in _PICTURES:
        from rangecheck.pipeline.explained import fit_scan

        return fit_scan(pictures[0], out, response=response, unit=unit, scale_mm=scale_mm, force=force, reporter=reporter)
    if (sphere is None) == (model is None):
        raise SettingError("name what the pictures show, one of --sphere COLUMN,ROW,RADIUS and --on MESH", key="sphere")
    if calibrate is not None:
        check_kind(calibrate, sphere, model, same_strength)
    elif out is None:
        raise SettingError("name the material file: -o FILE.toml", key="out")
    elif Path(out).suffix.lower() != ".toml":
        raise InputError(out, "would hold a material, and materials are read from .toml; name it so: -o FILE.toml")
    with reporter.stage("reading pictures"):
        values = [_linear(Path(p), response, green=calibrate is None) for p in pictures]
    if len({v.shape for v in values}) > 1:
        raise InputError(pictures[0], "has another size than the other pictures; give pictures of one size")
    if sphere is not None:
        _refuse_beside(sphere, values[0].shape[1], values[0].shape[0])
    if calibrate is not None and sphere is not None and calibrate != "bust":
        return on_sphere(pictures, values, sphere, calibrate, out, force, same_strength)
    given = None if lights in (None, STUDIO) else _directions(Path(str(lights)), len(pictures))
    shape = (values[0].shape[0], values[0].shape[1])
    names = (
        ("K_lm", "K_spike", "K_lobe", "sigma_um", "correlation_um") if spike else ("K_lm", "K_lobe", "sigma_um", "correlation_um")
    )
    if calibrate is not None and not same_strength:
        find = tuple(dict.fromkeys((*find, "strength")))
    free: dict[str, Any] = {_FREED.get(name, name): True for name in find}
    if sphere is not None:
        if "pose" in find:
            raise SettingError("a sphere's outline is its pose; --find pose is for --on MESH", key="find")
        if part is not None or lights == STUDIO:
            raise SettingError("a sphere has no parts and no studio; --part and --lights studio are for --on SCENE", key="part")
        sight = facing(sphere_sight(sphere[:2], sphere[2], shape))
        _refuse_unexposed(sight, pictures, values, noise)
        look, known = None, None
    else:
        look, subject = _look(str(model), values, noise, camera_mm, field_deg, part, settings, unit, reporter)
        sight = look.see()
        _refuse_unexposed(sight, pictures, values, noise)
        lit = given is None and (lights == STUDIO or (subject.model is not None and bool(subject.model.lamps)))
        known = scene_looked_at(subject, settings) if lit else None
        if known is not None and calibrate is not None:
            raise SettingError(
                f"{model} says where its lamps are; give --lights to have them looked for from there", key="lights"
            )
        if known is not None and out is not None:
            if lamp_distance_mm is not None or lamp_radius_deg is not None:
                raise SettingError(
                    f"{subject.name} says where its lamps are; give --lights to place them otherwise", key="lights"
                )
            return _in_a_scene(known, subject.name, look, names, free, settings, irradiance, out, pictures, force, reporter)
    middle, size = sight.points.mean(axis=0), max(float(np.ptp(sight.points, axis=0).max()), 1e-6)
    distance = lamp_distance_mm or size * (_NEAR if "distance" in find else _FAR)
    begun = given if given is not None else _first_directions(sight, values)
    lamps = tuple(Light(d, irradiance or _IRRADIANCE, middle, distance, lamp_radius_deg or _RADIUS_DEG) for d in begun)
    taken = photographs(sight, values, lamps, noise, None if look is None else look.caster)
    nodes = SEVEN_NODES if "radius" in find else ONE_NODE
    problem = Problem(taken, lamps, Guess(), Unknowns(names, one_camera=True, **free), nodes)
    from rangecheck.recover.fit import fit as solve

    if look is not None:
        reporter.note(
            "light is taken to come straight from the lamps; what the surface's parts throw on each other is followed only in a scene whose file has its lamps"
        )
    with reporter.stage("fitting"):
        fitted, found = (solve(problem, known_noise=False), None) if look is None else fit_looking(problem, look)
    if calibrate is not None:
        return on_bust(fitted, pictures, out, force, reporter.seconds)
    return _told(fitted, out, pictures, force, reporter, found)


def _in_a_scene(
    scene: Scene, name: str, look: Look, names: tuple[str, ...], free: dict[str, Any], settings: Any, irradiance: float | None, out: str,
    pictures: Sequence[str], force: bool, reporter: Reporter,
) -> Outcome:  # fmt: skip
    """The material of what `look` looks for in a scene whose lamps, surroundings and other parts are known."""
    # of a picture in colour green is taken, the middle one
    wave = scene.materials[0].wavelengths_um[scene.channels // 2]
    exposure = settings.picture.exposure
    unsaid = exposure is None and irradiance is None
    if unsaid and "exposure" not in free:
        raise SettingError(
            f"{name} has lamps of its own; say how bright the pictures are: --set picture.exposure=E (as they were rendered, and as render writes beside "
            "a picture), or --irradiance of the first lamp; or --find exposure, which parts of known material tell", key="irradiance",
        )  # fmt: skip
    own = own_material(scene, look.faces)
    n, k = own.index_at(wave)
    look.together = True
    look.scene = replace(look.scene, smooth=scene.smooth, vertex_normals=scene.vertex_normals)
    sight = look.see()
    lamps = lamps_of(scene, name, sight.points.mean(axis=0), exposure, irradiance)
    # a scene's lamps say how bright they are; only pictures may be exposed as nobody knows
    unknowns = Unknowns(names, direction=False, one_camera=True, first_fixed=not unsaid, **free)
    taken = photographs(sight, look.pictures, lamps, look.noise, look.caster, True)
    problem = Problem(
        taken, lamps, Guess(wavelength_um=wave, n=n or 0.0, k=k or 0.0), unknowns, SEVEN_NODES if "radius" in free else ONE_NODE
    )
    simulate = SceneSimulator(scene, look, lamps, settings, wave)
    witnesses = look.faces is not None and any(free.get(what) for what in ("exposure", "ambient", "pose"))
    with reporter.stage("fitting"):
        if unsaid:
            problem = exposed(problem, look, simulate, witnesses=witnesses)
        fitted, found, rests = fit_simulated(problem, look, simulate, witnesses=witnesses)
    metal = own if own.index_um else None
    return _told(replace(fitted, converged=rests), out, pictures, force, reporter, found, metal)


def _told(
    fitted: Fitted, out: str | None, pictures: Sequence[str], force: bool, reporter: Reporter, camera: CameraFound | None,
    metal: Material | None = None,
) -> Outcome:  # fmt: skip
    from rangecheck.recover.outcome import as_far_as_known, material_of, material_toml, with_what_is_taken

    assert out is not None
    unexplained = said_of_outliers(fitted)
    try:
        material, assumed = material_of(fitted, Path(out).stem, metal)
    except SceneError as refusal:
        # where the shape is another one, it is not the lamps' irradiance that is wrong
        if not unexplained:
            raise
        raise SceneError(f"no material is found: {unexplained[0]}", **refusal.measured) from None
    fitted = with_what_is_taken(as_far_as_known(fitted), material, unexplained)
    if camera is not None and not fitted.converged:
        camera = camera._replace(within_mm=None, turn_within_rad=None)
    names = ", ".join(Path(p).name for p in pictures)
    write_bytes(out, material_toml(material, fitted, f"fitted to {names}").encode(), force=force)
    lines = [f"{out}: residuals are {fitted.scale:.2f} times the noise, {100 * fitted.outliers:.1f} % of the pixels are outliers"]
    # the camera's pose is told as a whole: its numbers count from the last look
    estimates = [e for e in fitted.estimates if not e.name.startswith("camera")]
    lines += [_line(e) for e in estimates if "direction" not in e.name]
    lamps = [light.direction for light in fitted.problem.lights]
    lines += [f"  light {k}: towards {three(d)}{_within(fitted, k)}" for k, d in enumerate(lamps)]
    if camera is not None:
        lines += _camera_lines(camera)
    lines += assumed
    lines[1:1] = unexplained
    lines += [f"not determined: {said}" for said in fitted.statements if said not in unexplained]
    content = document(
        "fit", output=out, estimates=[vars(e) for e in estimates], lights=lamps, not_determined=fitted.statements,
        world_from_camera=None if camera is None else camera.world_from_camera,
        camera_within_mm=None if camera is None else camera.within_mm,
        camera_turn_within_deg=None if camera is None or camera.turn_within_rad is None else math.degrees(camera.turn_within_rad), residual_in_noises=fitted.scale, rms=fitted.rms, outliers=fitted.outliers, converged=fitted.converged,
        fit=not unexplained, inputs=hashes(list(pictures)), seconds=reporter.seconds,
    )  # fmt: skip
    return Outcome(content, lines, not unexplained)


def _camera_lines(camera: CameraFound) -> list[str]:
    pose = camera.world_from_camera
    place = "not determined" if camera.within_mm is None else f"each within {three(camera.within_mm, 2)} mm (95 %)"
    turn = (
        "not determined"
        if camera.turn_within_rad is None
        else f"any way within {math.degrees(camera.turn_within_rad):.2g} degrees (95 %)"
    )
    return [
        f"  camera: at {three(pose[:3, 3], 2)} mm, {place}",
        f"    looking along {three(pose[:3, 2])}, turned {turn}",
    ]


def _line(e: Estimate) -> str:
    if e.low is not None and e.high is not None:
        known = f"{e.low:.4g} to {e.high:.4g} (95 %)"
    else:
        known = "not determined" + (": the end of what is looked for" if e.at_bound else "")
    return f"  {e.name:<18} {e.value:.4g}{_UNITS.get(e.name.split()[-1], '')}  {known}"


def _within(fitted: Fitted, k: int) -> str:
    """How well a lamp's direction is known, in words."""
    if not any(e.name.startswith(f"light {k} direction") for e in fitted.estimates):
        return ", as the scene says"
    within = within_deg(fitted, k)
    return ", not determined" if within is None else f", within {within:.2g} degrees (95 %)"


def _linear(path: Path, response: str, *, green: bool) -> FloatArray:
    """A picture as parts of full scale, linear in light; of colours their luminance, or `green` alone, the light of one wavelength."""
    from rangecheck.scan.decode.capture import read_grey

    raw = read_grey(path, green=green)
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
    for row in rows:
        if not 0.0 < math.hypot(*row) < math.inf:
            raise InputError(
                path, f"holds {' '.join(f'{v:g}' for v in row)}, which is no direction; write x y z, towards the lamp"
            )
    return np.array(rows)


def _refuse_unexposed(sight: Sight, pictures: Sequence[str], values: Sequence[FloatArray], noise: float) -> None:
    """Raises InputError for a picture that shows no light of what is seen, or none that its sensor could count."""
    for path, picture in zip(pictures, values):
        seen = picture.reshape(-1)[sight.pixel]
        if seen.max() < _LEAST_LIGHT * noise and seen.mean() < noise:
            raise InputError(
                path, f"is dark where the object is: at most {seen.max():.2g} of full scale, where noise is {noise:g}; expose longer, or check where "
                "the object is, and --noise",
            )  # fmt: skip
        if (seen < 1.0).sum() < _LEAST_COUNTED:
            raise InputError(
                path, "is saturated everywhere on the object, which tells nothing of its shape or material; expose less"
            )


def _first_directions(sight: Sight, values: Sequence[FloatArray]) -> FloatArray:
    """Where the lamps stand if the surface were matt: linear least squares over the brighter half of each picture."""
    found = []
    for picture in values:
        seen = picture.reshape(-1)[sight.pixel]
        used = seen > 0.4 * np.quantile(seen, 0.9)
        found.append(np.linalg.lstsq(sight.normals[used], seen[used], rcond=None)[0])
    return np.array([f / max(float(np.linalg.norm(f)), 1e-12) for f in found])


def _look(
    path: str, values: Sequence[FloatArray], noise: float, camera_mm: tuple[float, ...] | None, field_deg: float | None, part: str | None,
    settings: Any, unit: str | None, reporter: Reporter,
) -> tuple[Look, Subject]:  # fmt: skip
    """What looks at the surface in `path`, and that."""
    subject = read_subject(path, settings, unit, reporter)
    surface, model = subject.surface, subject.model
    if part is not None and model is None:
        raise SettingError("only modelled scenes have parts; leave --part out", key="part")
    if camera_mm is not None:
        pose = np.array(rigid.look_at(camera_mm, surface.bounds_mm.mean(axis=0)))
    elif model is not None and model.world_from_camera is not None:
        pose, field_deg = np.array(model.world_from_camera), field_deg or field_of(model)
    else:
        raise SettingError("say where the camera stood: --camera X,Y,Z in mm; it looks at the middle of the object", key="camera")
    normals = None if model is None else np.nan_to_num(model.corner_normals)
    scene = Scene(surface, (Material("grey", K_lm=0.5, wavelengths_um=(0.555,)),), smooth=True, vertex_normals=normals)
    camera = PinholeCamera.from_field_of_view(values[0].shape[1], values[0].shape[0], field_deg or _FIELD_DEG)
    faces = None if model is None else faces_of(model, part)
    return Look(scene, EmbreeCaster(surface.vertices, surface.faces), camera, pose, values, noise, faces), subject


def _refuse_beside(sphere: tuple[float, float, float], width: int, height: int) -> None:
    """Raises SettingError unless the circle's middle is in the picture, which it does not exceed."""
    column, row, radius = sphere
    if not (0 <= column < width and 0 <= row < height and 0 < 2 * radius <= max(width, height)):
        raise SettingError(
            f"--sphere: a circle of radius {radius:g} around column {column:g}, row {row:g} is not in a picture of {width}x{height}; give its outline "
            "as the picture shows it", key="sphere",
        )  # fmt: skip
