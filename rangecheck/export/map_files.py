"""Maps as files: one NPZ with units in its names, 16-bit PNGs with their scale, and coloured PNGs with legends for people."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import InputError, RangecheckError
from rangecheck.export.legend import NOTHING as NOTHING_COLOUR
from rangecheck.export.legend import Swatches, framed, span_text
from rangecheck.export.mapped import coloured_ids, coloured_map, coloured_normals, contour_picture, range_of
from rangecheck.export.pictures import write_id_png16, write_map_png16, write_normals_png16, write_png
from rangecheck.files import DAMAGED_ARCHIVE, read_bytes, whole_file, write_json
from rangecheck.maps import Chain, Maps, Shadows
from rangecheck.maps.shadow import LIT, NOTHING, SHADED, STATE_NAMES, TURNED_AWAY
from rangecheck.optics import OrthographicCamera, PinholeCamera, camera_from_dict

SCHEMA = "rangecheck/maps/1"
#: share of the pixels whose signed values the colours reach; a few far ones would leave the others white
SHOWN = 0.99


def describe(maps: Maps) -> dict[str, Any]:
    """JSON-ready: camera, pose and part names of the maps."""
    return {
        "schema": SCHEMA,
        "camera": maps.camera.to_dict(),
        "world_from_camera": maps.world_from_camera.tolist(),
        "part_names": list(maps.part_names),
        "length_unit": "mm",
    }


def arrays_of(maps: Maps) -> dict[str, FloatArray | IntArray]:
    """The maps by name: distance_mm, depth_mm (float64, NaN = nothing), normals, incidence_rad (float32), part_id (0 = none), face (-1 = none)."""
    return {name: getattr(maps, name) for name in ("distance_mm", "depth_mm", "normals", "incidence_rad", "part_id", "face")}


def write_maps_npz(path: str | Path, maps: Maps, more: Mapping[str, FloatArray] | None = None, *, force: bool = True) -> None:
    """NPZ of `arrays_of`, `more` maps by name, world_from_camera, and `description`, a JSON text with camera and part names."""
    arrays = (
        arrays_of(maps)
        | dict(more or {})
        | {
            "world_from_camera": maps.world_from_camera,
            "description": np.array(json.dumps(describe(maps), sort_keys=True)),
        }
    )
    with whole_file(path, force=force) as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def read_maps_npz(path: str | Path) -> Maps:
    """The maps that `write_maps_npz` wrote. Raises InputError."""
    content = io.BytesIO(read_bytes(path))
    try:
        with np.load(content, allow_pickle=False) as found:
            description = json.loads(str(found["description"]))
            return Maps(
                camera=camera_from_dict(description["camera"]),
                part_names=tuple(description["part_names"]),
                **{
                    name: found[name]
                    for name in ("world_from_camera", "distance_mm", "depth_mm", "normals", "incidence_rad", "part_id", "face")
                },
            )
    except (*DAMAGED_ARCHIVE, RangecheckError) as error:
        raise InputError(path, f"does not hold maps ({error}); it must be an NPZ that `rangecheck maps` wrote") from None


def write_maps(
    folder: str | Path,
    maps: Maps,
    *,
    stem: str = "",
    subtitle: str = "",
    more: Mapping[str, FloatArray] | None = None,
    force: bool = True,
) -> list[Path]:
    """All files of one set of maps in `folder`, their names led by `stem`: maps.npz (with `more` maps), distance, depth, incidence,
    normals and part_id as *_16bit.png and coloured .png, and contours.png. Returns the paths."""
    where = Path(folder)
    written: list[Path] = []

    def named(name: str) -> Path:
        written.append(where / f"{stem}{name}")
        return written[-1]

    write_maps_npz(named("maps.npz"), maps, more, force=force)
    whence = "from the focal point" if isinstance(maps.camera, PinholeCamera) else "along the rays"
    floats = (
        ("distance", maps.distance_mm, "mm", f"Distance {whence}", "viridis"),
        ("depth", maps.depth_mm, "mm", "Depth along the optical axis", "viridis"),
        ("incidence", np.degrees(maps.incidence_rad.astype(np.float64)), "deg", "Angle of incidence", "magma"),
    )
    for name, values, unit, title, colours in floats:
        write_map_png16(named(f"{name}_16bit.png"), values, name, unit, force=force)
        write_png(named(f"{name}.png"), coloured_map(values, title, unit, subtitle=subtitle, colours=colours), force=force)
    write_normals_png16(named("normals_16bit.png"), maps.normals, force=force)
    write_png(named("normals.png"), coloured_normals(maps.normals, "Normals"), force=force)
    if len(maps.part_names) <= 65535:
        write_id_png16(named("part_id_16bit.png"), maps.part_id, maps.part_names, force=force)
        picture = coloured_ids(maps.part_id, maps.part_names, "Surface seen first", subtitle=subtitle)
        write_png(named("part_id.png"), picture, force=force)
    write_png(
        named("contours.png"), contour_picture(maps.depth_mm, pixel_mm=_pixel_mm(maps), title="Contours of depth"), force=force
    )
    return written


def _pixel_mm(maps: Maps) -> float | None:
    """Width of a pixel: of an orthographic camera's, or at the median depth of a pinhole's; None for others and for empty pictures."""
    if isinstance(maps.camera, OrthographicCamera):
        return maps.camera.pixel_mm
    if isinstance(maps.camera, PinholeCamera) and maps.hit.any():
        return abs(float(np.nanmedian(maps.depth_mm))) / maps.camera.fx or None
    return None


def write_chain(folder: str | Path, maps: Maps, chain: Chain, *, stem: str = "", force: bool = True) -> list[Path]:
    """Secondary IDs: exact 16-bit PNG of each reflection, a coloured picture of the first, chain.npz (part_ids, faces), and
    reflections.json, the table of which surface mirrors which. Returns the paths."""
    where = Path(folder)
    paths = [where / f"{stem}{name}" for name in ("chain.npz", "reflections.json", "secondary_id.png")]
    with whole_file(paths[0], force=force) as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, part_ids=chain.part_ids, faces=chain.faces)
    rows = [{"surface": a, "mirrors": b, "pixels": n} for a, b, n in chain.pairs(maps)]
    write_json(paths[1], {"schema": "rangecheck/reflections/1", "part_names": list(chain.part_names), "pairs": rows}, force=force)
    write_png(
        paths[2], coloured_ids(chain.secondary_id, chain.part_names, "Surface seen in the mirror", seen=maps.hit), force=force
    )
    for bounce, ids in enumerate(chain.part_ids):
        paths.append(where / f"{stem}secondary_id_{bounce + 1}_16bit.png")
        write_id_png16(paths[-1], ids, chain.part_names, force=force, reflection=bounce + 1)
    return paths


def write_shadows(
    folder: str | Path, shadows: Shadows, source_names: Sequence[str], *, stem: str = "", force: bool = True
) -> list[Path]:
    """shadows.npz (state, shaded_by) and one coloured picture per source. Returns the paths."""
    where = Path(folder)
    paths = [where / f"{stem}shadows.npz"]
    with whole_file(paths[0], force=force) as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, state=shadows.state, shaded_by=shadows.shaded_by)
    colours = np.array([NOTHING_COLOUR, (255, 236, 179), (120, 128, 150), (52, 58, 78)], np.uint8)
    order = [LIT, TURNED_AWAY, SHADED]
    for name, state in zip(source_names, shadows.state, strict=True):
        seen = max(1, int((state != NOTHING).sum()))
        shares = tuple(f"{STATE_NAMES[k]}, {100 * (state == k).sum() / seen:.1f} %" for k in order)
        paths.append(where / f"{stem}shadow_{len(paths)}.png")
        write_png(paths[-1], framed(colours[state], f"Light of {name}", scale=Swatches(colours[order], shares)), force=force)
    return paths


def write_value_map(
    folder: str | Path, name: str, values: FloatArray, title: str, unit: str, *, signed: bool = False, force: bool = True
) -> list[Path]:
    """A map of a value carried by the surface (see `maps.values_seen`) as `name`_16bit.png and a coloured picture; a signed one
    is drawn about 0, blue below and red above, up to the size that SHOWN of the pixels keep. Returns the paths."""
    where = Path(folder)
    paths = [where / f"{name}_16bit.png", where / f"{name}.png"]
    write_map_png16(paths[0], values, name, unit, force=force)
    if signed:
        size = np.abs(values[np.isfinite(values)])
        reach = float(np.quantile(size, SHOWN)) if len(size) else 0.0
        reach = reach or float(size.max(initial=0.0)) or 1.0
        subtitle = ""
        if size.max(initial=0.0) > reach:
            subtitle = f"{span_text(*range_of(values))} {unit}; the colours end where {100 * SHOWN:.0f} % of the pixels do"
        picture = coloured_map(values, title, unit, subtitle=subtitle, low=-reach, high=reach, colours="RdBu_r")
    else:
        picture = coloured_map(values, title, unit)
    write_png(paths[1], picture, force=force)
    return paths
