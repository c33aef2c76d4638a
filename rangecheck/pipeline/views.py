"""Where pictures are taken from, and what needs no light: maps and line drawings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from rangecheck.animation import Orbit, orbit_around
from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import InputError, OutputError, SceneError
from rangecheck.export.camera_files import write_camera_json
from rangecheck.export.map_files import write_chain, write_maps, write_shadows, write_value_map
from rangecheck.maps import (
    Maps,
    SeenDeviation,
    back_projection_error,
    deviation_seen,
    require_outside,
    trace_chain,
    trace_maps,
    trace_shadows,
)
from rangecheck.optics import Camera, CylindricalCamera, OrthographicCamera, PinholeCamera
from rangecheck.pipeline.camera import camera_of, lensless
from rangecheck.pipeline.folder import check_free, check_writable
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import Subject, read_subject
from rangecheck.progress import Reporter
from rangecheck.raycast import EmbreeCaster
from rangecheck.rigid import look_at
from rangecheck.surface import Surface


def orbit_of(surface: Surface, settings: Settings) -> Orbit:
    """The tightest orbit whose every frame holds the whole surface."""
    turn = settings.turntable
    return orbit_around(
        surface,
        camera_of(settings),
        frames=turn.frames,
        elevation_deg=turn.elevation_deg,
        margin=turn.margin,
        start_deg=turn.start_deg,
        swing_deg=turn.swing_deg,
    )


def view_of(subject: Subject, settings: Settings, camera_mm: tuple[float, ...] | None) -> tuple[Camera, FloatArray]:
    """The camera and its pose: at `camera_mm` looking at the middle of the object; else as a modelled scene's own file says; else
    the first view of the orbit of a pinhole. Raises SceneError when that is inside the object.

    A size that was asked for goes over that of a scene's file, whose camera keeps its field of view."""
    kind, surface, model = settings.picture.camera, subject.surface, subject.model
    pinhole = settings.model_copy(update={"picture": settings.picture.model_copy(update={"camera": "pinhole"})})
    camera: Camera = camera_of(pinhole)
    if camera_mm is not None:
        pose = look_at(camera_mm, surface.bounds_mm.mean(axis=0))
    elif model is not None and model.camera is not None and model.world_from_camera is not None:
        camera, pose = _as_large_as_asked(model.camera, settings), model.world_from_camera
    else:
        pose = orbit_of(surface, pinhole).world_from_camera(0)
    if kind != "pinhole":
        camera, pose = lensless(settings, surface, pose)
    require_outside(surface, camera, pose)
    return camera, pose


def _as_large_as_asked(camera: PinholeCamera, settings: Settings) -> PinholeCamera:
    """A scene's own camera, with pixels of the settings where they were set."""
    picture = settings.picture
    if not picture.model_fields_set & {"width", "height"}:
        return camera
    across = 2 * math.degrees(math.atan(camera.width / (2 * camera.fx)))
    return PinholeCamera.from_field_of_view(picture.width, picture.height, across)


def seen_by(camera: Camera) -> str:
    """A camera without a lens in words; nothing of a pinhole, which everybody expects."""
    if isinstance(camera, OrthographicCamera):
        return f"camera: orthographic, pixels of {camera.pixel_mm:.4g} mm"
    if isinstance(camera, CylindricalCamera):
        return f"camera: cylindrical, a whole turn at {camera.radius_mm:.4g} mm from the axis, rows of {camera.row_mm:.4g} mm"
    return ""


def refuse_existing(path: str | Path, force: bool) -> None:
    """Raise OutputError when `path` exists and may not be replaced, or cannot be written."""
    check_writable(path)
    if Path(path).exists() and not force:
        raise OutputError(path, "exists already; pass --force to replace it")


def _refuse_what_shows_nothing(name: str, measured: Maps) -> None:
    """Raises SceneError where a focal point sees nothing, or lies on the surface itself."""
    eye = ", ".join(f"{x:z.1f}" for x in measured.world_from_camera[:3, 3])
    if not measured.hit.any():
        raise SceneError(f"nothing of {name} is seen from the focal point ({eye}) mm; say another --camera")
    if float(np.nanmax(measured.distance_mm)) <= 0.0:
        raise SceneError(
            f"the focal point ({eye}) mm lies on the surface of {name}, so no distance is above 0; say another --camera"
        )


def map_at(surface: Surface, settings: Settings, azimuth_deg: float) -> tuple[Maps, str]:
    """Maps from a focal point of its own orbit at `azimuth_deg`, and where that is in words."""
    camera = camera_of(settings)
    orbit = orbit_around(
        surface,
        camera,
        frames=1,
        elevation_deg=settings.maps.elevation_deg,
        margin=settings.turntable.margin,
        start_deg=azimuth_deg,
    )
    pose = orbit.world_from_camera(0)
    eye = ", ".join(f"{x:.0f}" for x in pose[:3, 3])
    return trace_maps(surface, camera, pose), f"focal point at ({eye}) mm"


def maps(
    path: str,
    out: str,
    *,
    settings: Settings,
    unit: str | None,
    camera_mm: tuple[float, ...] | None,
    bounces: int = 1,
    against: str | None = None,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """All maps of what is in `path` from one focal point, proved by projecting them back onto the surface; for a modelled scene
    also the chain of surfaces that its mirror rays meet, and its sources' shadows; and how far what is seen lies from what is in
    `against`, a mesh, scans or a scene in the same frame."""
    check_free(out, "maps.npz", force=force)
    subject = read_subject(path, settings, unit, reporter)
    other = None if against is None else read_subject(against, settings, unit, reporter)
    camera, pose = view_of(subject, settings, camera_mm)
    surface, model = subject.surface, subject.model
    normals = None if model is None else model.normals_at
    with reporter.stage("measuring"):
        caster = EmbreeCaster(surface.vertices, surface.faces)
        measured = trace_maps(surface, camera, pose, caster)
        _refuse_what_shows_nothing(subject.name, measured)
        chain = trace_chain(surface, measured, caster, bounces=bounces, normals=normals)
        proof = back_projection_error(surface, measured)
        apart = None if other is None else deviation_seen(measured, other.surface)
    with reporter.stage("writing"):
        eye = ", ".join(f"{x:.0f}" for x in pose[:3, 3])
        more = {} if apart is None else {"deviation_mm": apart.distance_mm}
        subtitle = f"focal point at ({eye}) mm" if camera.model == "pinhole" else f"{camera.model} camera at ({eye}) mm"
        written = write_maps(out, measured, subtitle=subtitle, more=more)
        if apart is not None and other is not None:
            written += write_value_map(
                out, "deviation", apart.distance_mm, f"Deviation from {other.name}, positive outside", "mm", signed=True
            )
        written += write_chain(out, measured, chain)
        if model is not None and model.lamps:
            lamps = np.array([(*lamp.centre_mm, 1.0) for lamp in model.lamps])
            shadows = trace_shadows(surface, measured, lamps, caster, normals=normals, lift_mm=2 * model.tolerance_mm)
            written += write_shadows(out, shadows, [f"source {k + 1}" for k in range(len(lamps))])
        write_camera_json(Path(out) / "camera.json", camera, pose)
    nearest, farthest = float(np.nanmin(measured.distance_mm)), float(np.nanmax(measured.distance_mm))
    lines = [
        f"{out}: {len(written) + 1} files; distances {nearest:.2f} to {farthest:.2f} mm over {int(measured.hit.sum()):,} pixels",
        f"projected back, no point lies further than {proof.distance_max_mm:.2g} mm from the surface (bound {proof.bound_mm:.2g} mm)",
    ]
    lines += [said for said in [seen_by(camera)] if said]
    if apart is not None and other is not None:
        lines += _apart(apart, other.name)
    if model is not None:
        lines += [
            f"  {seen} mirrors {met}: {pixels:,} pixels" for seen, met, pixels in chain.pairs(measured) if met != "nothing"
        ][:12]
    return Outcome(
        document(
            "maps",
            files=written,
            nearest_mm=nearest,
            farthest_mm=farthest,
            pixels=int(measured.hit.sum()),
            part_names=surface.part_names,
            back_projection={
                "distance_max_mm": proof.distance_max_mm,
                "depth_max_mm": proof.depth_max_mm,
                "bound_mm": proof.bound_mm,
                "holds": proof.holds,
            },
            deviation=None
            if apart is None or other is None
            else {"from": other.name, "pixels": apart.faced, **apart.statistics()},
            camera=camera.to_dict(),
            world_from_camera=pose,
            seconds=reporter.seconds,
        ),
        lines,
        proof.holds,
    )


def _apart(found: SeenDeviation, name: str) -> list[str]:
    """What the deviation map says, in lines."""
    if not found.faced:
        return [f"nothing of {name} faces what is seen; both must be in one frame and unit"]
    said = found.statistics()
    lines = [
        f"from {name}: {said['mean_mm']:+.3g} mm on average, RMS {said['rms_mm']:.3g}, 95 % within {said['p95_mm']:.3g}, "
        f"from {said['lowest_mm']:+.3g} to {said['highest_mm']:+.3g} mm (positive: outside it)"
    ]
    if found.faced < found.seen:
        lines.append(f"nothing of {name} faces {100 * (1 - found.faced / found.seen):.1f} % of what is seen: left out")
    return lines


def draw(
    path: str, out: str, *, settings: Settings, camera_mm: tuple[float, ...] | None, hidden: bool, force: bool, reporter: Reporter
) -> Outcome:
    """A line drawing of a modelled scene as SVG."""
    from rangecheck.modeler import draw as draw_lines
    from rangecheck.modeler import write_svg

    if Path(out).suffix.lower() != ".svg":
        raise OutputError(out, "must end in .svg")
    refuse_existing(out, force)
    if Path(path).suffix.lower() != ".toml":
        raise InputError(
            path, "is no modelled scene; a line drawing needs faces that know their edges, as a scene's .toml file gives them"
        )
    subject = read_subject(path, settings, None, reporter)
    assert subject.model is not None
    if settings.picture.camera != "orthographic":
        # lines stay straight in these two alone
        camera_of(settings)
    camera, pose = view_of(subject, settings, camera_mm)
    with reporter.stage("drawing"):
        drawing = draw_lines(subject.model, camera, pose, hidden=hidden)
    write_svg(out, drawing, subject.name, force=force)
    visible = sum(line.visible for line in drawing.lines)
    return Outcome(
        document("draw", output=out, lines=len(drawing.lines), visible=visible, camera=camera.to_dict(), world_from_camera=pose),
        [f"{out}: {visible} visible lines of {len(subject.surface.part_names)} faces"],
    )
