"""simulate: what a range finder would have measured of a mesh, or what its cameras would have seen of its patterns, with the truth beside."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import ScanError, SettingError
from rangecheck.files import whole_file
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.folder import check_free, job_folder, key_of
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import hashes
from rangecheck.progress import Reporter
from rangecheck.reflectance.material import Material
from rangecheck.scan.simulate import (
    KINECT,
    REASONS,
    Finish,
    Motion,
    RangeFinder,
    SimulatedScan,
    finder_to_dict,
    ring_of_poses,
    simulate_scan,
)
from rangecheck.scan.simulate_noise import SOURCES, SPEED_OF_LIGHT_MM_S

#: across the camera's width
FIELD_DEG = 40.0
#: light, relative to white matt at the working distance, between which a sensor that looks at a material tells something
LEAST_SIGNAL, MOST_SIGNAL = 0.01, 3.0
#: the first Kinect measures from here on; its noise was measured from 0.9 m
KINECT_NEAREST_MM = 900.0


@dataclass(frozen=True)
class Instrument:
    """What is asked of the range finder and of its subject, as the command's options say it.

    kind, noise_model, noise_mm, ambient   of the finder; `numbers` are further numbers of it, KEY=VALUE, and go before everything
    material     name or file of what the subject is made of; None: white matt
    drift_mm_s, turn_deg_s   how the subject moves, the turn about the upright axis through its middle
    brightness   whether the camera's picture is kept with each scan
    pictures     Gray code: the pictures of the patterns, from `cameras` cameras, instead of what a finder makes of them"""

    kind: str = "stripe"
    noise_model: str = "quadratic"
    noise_mm: float = 0.2
    ambient: float = 0.0
    material: str | None = None
    drift_mm_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg_s: float = 0.0
    numbers: tuple[str, ...] = ()
    brightness: bool = False
    pictures: bool = False
    cameras: int = 1


def simulate(
    path: str,
    out: str,
    *,
    unit: str | None,
    views: int,
    instrument: Instrument,
    size: tuple[int, int],
    seed: int,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """Scans of a mesh from a ring of views, as depth pictures with a manifest; or the pictures of the patterns, a capture for each view."""
    from rangecheck.raycast import EmbreeCaster
    from rangecheck.reflectance import load_material
    from rangecheck.surface.mesh_files import read_mesh

    if instrument.pictures and instrument.kind != "gray-code":
        raise SettingError("pictures of patterns are those of gray-code; add --kind gray-code", key="pictures")
    finished = f"{view_name(views - 1)}/capture.json" if instrument.pictures else "scans.json"
    check_free(out, finished, force=force)
    material = load_material(instrument.material) if instrument.material else None
    with reporter.stage("reading mesh"):
        surface = read_mesh(path, unit)
    low, high = surface.bounds_mm
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    if not radius > 0:
        raise ScanError(f"{path}: its vertices are all in one place; there is nothing to measure")
    if instrument.noise_mm > 0.5 * radius:
        raise ScanError(
            f"{path}: is {2 * radius:.3g} mm across, and noise of {instrument.noise_mm:g} mm would leave nothing of it; check --unit, or choose "
            "--noise-mm",
            across_mm=2 * radius,
        )
    camera = PinholeCamera.from_field_of_view(*size, FIELD_DEG)
    # the smaller field of view holds the sphere around the object
    distance = 1.05 * radius / math.sin(math.atan(0.5 * min(size) / camera.fx))
    if instrument.noise_model == "kinect":
        distance = max(distance, radius + KINECT_NEAREST_MM)
    finder = finder_of(instrument, distance, radius)
    finish = None if material is None else finish_of(material, finder.wavelength_um)
    motion = None
    if any(instrument.drift_mm_s) or instrument.turn_deg_s:
        motion = Motion(instrument.drift_mm_s, instrument.turn_deg_s, centre_mm=tuple(middle.tolist()))
    subject = _Subject(EmbreeCaster(surface.vertices, surface.faces), finish or Finish(), motion)
    poses = ring_of_poses(views, distance, target_mm=middle, elevations_deg=(-12.0, 38.0) if views > 1 else (10.0,))
    key = key_of(inputs=hashes([path]), unit=unit, views=views, size=size, seed=seed, **vars(instrument))
    told = {
        "kind": instrument.kind, "distance_mm": distance, "noise_mm": finder.noise_mm, "seed": seed, "inputs": hashes([path]),
        "instrument": {k: None if v == math.inf else v for k, v in finder_to_dict(finder).items()},
        "finish": None if finish is None else vars(finish),
        "motion": None if motion is None else vars(motion),
    }  # fmt: skip
    if instrument.pictures:
        from rangecheck.pipeline.simulated_pictures import projector_for, write_captures

        with job_folder(out, key, finished, force=force) as folder:
            captures = write_captures(folder, subject, camera, poses, middle, finder, instrument.cameras, seed, reporter)
        cells = projector_for(camera)
        lines = [
            f"{out}: {views} captures of {instrument.cameras} camera{'s' * (instrument.cameras > 1)} of {size[0]}x{size[1]}, "
            f"projector {cells.width}x{cells.height} at {distance:.0f} mm; decode, mesh and run take each of its folders",
            f"the truth of each is in its truth.npz; {_about(material, finish, motion)}",
        ]
        return Outcome(document("simulate", captures=captures, **told), lines)
    made = []
    with reporter.stage("simulating", views):
        for index, pose in enumerate(poses):
            one = simulate_scan(
                subject.caster, camera, pose, finder, seed, scan_index=index, name=view_name(index),
                with_brightness=instrument.brightness, finish=subject.finish, motion=motion,
            )  # fmt: skip
            made.append(_something(one))
            reporter.advance(index + 1)
    manifest = _write(out, key, made, finder, force, reporter)
    reasons = {name: int(sum((one.reason == k).sum() for one in made)) for k, name in enumerate(REASONS)}
    valid = [int(one.scan.valid.sum()) for one in made]
    lines = [
        f"{manifest}: {views} scans of {size[0]}x{size[1]}, {sum(valid):,} distances, {instrument.kind}, {_noise_said(finder)}",
        _lost_said(reasons),
        f"the truth of each, cell by cell, is in {Path(out) / 'truth'}; {_about(material, finish, motion)}",
    ]
    return Outcome(document("simulate", manifest=manifest, valid=valid, reasons=reasons, **told), [one for one in lines if one])


@dataclass(frozen=True)
class _Subject:
    """What is measured: what rays meet, how it gives light back, and how it moves."""

    caster: Any
    finish: Finish
    motion: Motion | None


def view_name(index: int) -> str:
    """Of a view, and of its files."""
    return f"view_{index:02d}"


def finder_of(instrument: Instrument, distance_mm: float, radius_mm: float) -> RangeFinder:
    """The range finder at `distance_mm` from the middle of a subject of `radius_mm`. Depth comes in tenths of the noise, or in what 65535
    counts need to reach behind the subject, if that is more; light is modulated slowly enough for it. Raises SettingError."""
    step = max(instrument.noise_mm / 10, 1.05 * (distance_mm + radius_mm) / 65535)
    base = RangeFinder(source_mm=(distance_mm / 4, 0.0, 0.0), working_distance_mm=distance_mm)
    given: dict[str, Any] = {"noise_mm": instrument.noise_mm, "step_mm": step}
    if instrument.noise_model == "kinect":
        base, given = replace(KINECT, working_distance_mm=distance_mm), {"step_mm": max(KINECT.step_mm, step)}
    if instrument.material is not None:
        given |= {"least_signal": LEAST_SIGNAL, "most_signal": MOST_SIGNAL}
    # ranges wrap at c / (2 f): the subject must end before
    given["modulation_mhz"] = min(base.modulation_mhz, SPEED_OF_LIGHT_MM_S / (2.1 * (distance_mm + radius_mm)) / 1e6)
    asked: dict[str, Any] = {"kind": instrument.kind, "noise_model": instrument.noise_model, "ambient": instrument.ambient}
    finder = replace(base, **given, **asked)
    return replace(finder, **dict(map(_number, instrument.numbers)))


def _number(assignment: str) -> tuple[str, Any]:
    """KEY=VALUE as a field of `RangeFinder`, of its kind."""
    key, equals, text = assignment.partition("=")
    known = {f.name: f.default for f in fields(RangeFinder) if f.default is not MISSING}
    if not equals:
        raise SettingError(f"--finder takes key=value; got {assignment!r}, for example --finder lost_share=0.1", key=key)
    if key not in known:
        near = difflib.get_close_matches(key, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"its numbers are {', '.join(known)}"
        raise SettingError(f"a range finder has no {key!r}; {hint}", key=key)
    kind = type(known[key])
    try:
        return key, tuple(map(float, text.split(","))) if kind is tuple else kind(text)
    except ValueError:
        wanted = "three numbers, X,Y,Z" if kind is tuple else "a whole number" if kind is int else "a number"
        raise SettingError(f"finder {key} is {text!r}; it must be {wanted}", key=key) from None


def finish_of(material: Material, wavelength_um: float) -> Finish:
    """How a finder's light comes back from a material: its matt share, and its lobe as a Beckmann lobe of the same width.

    With g = (4 pi sigma / lambda)^2, order m of the lobe has the probability e^-g g^m / m! and tilts the mirror direction like facets of
    slope sqrt(m) lambda / (2 pi T); g / (1 - e^-g) is the mean order of what is scattered at all, and makes 2 sigma / T of rough surfaces. The spike
    (order 0) shows a source of no extent to no camera that does not stand in its mirror image, and is left out: polished steel is dark."""
    from rangecheck.reflectance.fresnel import conductor_fresnel

    order = np.argsort(material.wavelengths_um)
    matt, _, lobe, both = (
        float(np.interp(wavelength_um, np.array(material.wavelengths_um)[order], strength[order]))
        for strength in material.strengths()
    )
    n, k = material.index_at(wavelength_um)
    fresnel = 1.0 if n is None or k is None else float(conductor_fresnel(1.0, n, k))
    g = (4 * math.pi * material.sigma_um / wavelength_um) ** 2
    scattered = -math.expm1(-g)
    if scattered < 1e-12:
        return Finish(diffuse=matt)
    slope = math.sqrt(g / scattered) * wavelength_um / (2 * math.pi * material.correlation_um)
    return Finish(diffuse=matt, specular=min((lobe + both * scattered) * fresnel, 1 - matt), rms_slope=slope)


def _something(one: SimulatedScan) -> SimulatedScan:
    """The scan, if anything came back. Raises ScanError that says what kept it."""
    if one.scan.valid.any():
        return one
    counts = np.bincount(one.reason.ravel(), minlength=len(REASONS))
    met = {name: int(n) for name, n in zip(REASONS, counts) if n and name != "nothing there"}
    why = (
        ", ".join(f"{n:,} cells {name}" for name, n in sorted(met.items(), key=lambda pair: -pair[1]))
        or "its camera meets nothing"
    )
    raise ScanError(
        f"{one.scan.name}: no cell would return a distance ({why}); choose another material, noise model or kind, or change the instrument "
        "(--finder)",
        name=one.scan.name,
    )


def _write(out: str, key: str, made: Sequence[SimulatedScan], finder: RangeFinder, force: bool, reporter: Reporter) -> Path:
    from rangecheck.scan.readers import write_scans

    # time of flight wraps, and a wrapped reading may lie far behind everything: the step grows then, and the manifest says it
    farthest = max(float(np.nanmax(one.scan.depth_mm)) for one in made)
    step = max(finder.step_mm or finder.working_distance_mm * 2 / 65535, farthest * 1.000001 / 65535)
    scans = [
        replace(one.scan, range_mm=np.where(one.scan.depth_mm < step, np.float32(np.nan), one.scan.range_mm)) for one in made
    ]
    with reporter.stage("writing"), job_folder(out, key, "scans.json", force=force) as folder:
        for one in made:
            with whole_file(folder / "truth" / f"{one.scan.name}.npz") as part, part.open("wb") as stream:
                np.savez_compressed(
                    stream, true_range_mm=one.true_range_mm, true_normal=one.true_normal, noise_mm=one.noise_mm, reason=one.reason,
                    signal=one.signal, time_s=one.time_s,
                )  # fmt: skip
        # last: with its manifest the folder is finished
        return write_scans(folder, scans, step_mm=step)


def _noise_said(finder: RangeFinder) -> str:
    if finder.kind == "gray-code":
        return f"{finder.columns} columns decoded to {finder.column_noise:g} of one and rounded, depth in steps of {finder.step_mm:.3g} mm"
    model = "photon" if finder.kind == "time-of-flight" else finder.noise_model
    stated = f"{finder.noise_mm:g} mm at {finder.working_distance_mm:.0f} mm " if model in ("quadratic", "photon") else ""
    if finder.kind == "time-of-flight":
        stated += f"and {finder.modulation_mhz:.3g} MHz "
    return f"noise {stated}by the {model} model ({SOURCES[model]}), depth in steps of {finder.step_mm:.3g} mm"


def _lost_said(reasons: dict[str, int]) -> str:
    met = sum(n for name, n in reasons.items() if name != "nothing there")
    lost = {name: n for name, n in reasons.items() if n and name not in ("measured", "nothing there")}
    return (
        "of the cells that meet the subject: " + ", ".join(f"{100 * n / met:.1f} % {name}" for name, n in lost.items())
        if lost
        else ""
    )


def _about(material: Material | None, finish: Finish | None, motion: Motion | None) -> str:
    said = "white matt" if material is None or finish is None else (
        f"{material.name}: {finish.diffuse:.2f} matt, {finish.specular:.2f} in a lobe of slope {finish.rms_slope:.3f}"
    )  # fmt: skip
    if motion is None:
        return said
    x, y, z = motion.velocity_mm_s
    return f"{said}, drifting by ({x:g}, {y:g}, {z:g}) mm/s and turning at {motion.turn_deg_s:g} degrees/s; the truth is that of time 0"
