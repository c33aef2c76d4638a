"""Maps as files: one NPZ with units in its names, 16-bit PNGs with their scale, and coloured PNGs with legends for people."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from rangecheck.errors import InputError, RangecheckError
from rangecheck.export.mapped import coloured_ids, coloured_map, contour_picture
from rangecheck.export.pictures import write_id_png16, write_map_png16, write_png
from rangecheck.files import read_bytes, whole_file
from rangecheck.maps import Maps
from rangecheck.optics import camera_from_dict

SCHEMA = "rangecheck/maps/1"


def describe(maps: Maps) -> dict[str, Any]:
    """JSON-ready: camera, pose and part names of the maps."""
    return {
        "schema": SCHEMA,
        "camera": maps.camera.to_dict(),
        "world_from_camera": maps.world_from_camera.tolist(),
        "part_names": list(maps.part_names),
        "length_unit": "mm",
    }


def write_maps_npz(path: str | Path, maps: Maps, *, force: bool = True) -> None:
    """NPZ of distance_mm, depth_mm (float64, NaN = nothing), normals, incidence_rad (float32), part_id (0 = none), face (-1 = none),
    world_from_camera, and `description`, a JSON text with camera and part names."""
    arrays = {
        "distance_mm": maps.distance_mm,
        "depth_mm": maps.depth_mm,
        "normals": maps.normals,
        "incidence_rad": maps.incidence_rad,
        "part_id": maps.part_id,
        "face": maps.face,
        "world_from_camera": maps.world_from_camera,
        "description": np.array(json.dumps(describe(maps), sort_keys=True)),
    }
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
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, RangecheckError) as error:
        raise InputError(path, f"does not hold maps ({error}); it must be an NPZ that `rangecheck maps` wrote") from None


def write_maps(folder: str | Path, maps: Maps, *, stem: str = "", subtitle: str = "", force: bool = True) -> list[Path]:
    """All files of one set of maps in `folder`, their names led by `stem`: maps.npz, distance, depth, incidence and part_id as
    *_16bit.png and coloured .png, and contours.png. Returns the paths."""
    where = Path(folder)
    written: list[Path] = []

    def named(name: str) -> Path:
        written.append(where / f"{stem}{name}")
        return written[-1]

    write_maps_npz(named("maps.npz"), maps, force=force)
    floats = (
        ("distance", maps.distance_mm, "mm", "Distance from the focal point", "viridis"),
        ("depth", maps.depth_mm, "mm", "Depth along the optical axis", "viridis"),
        ("incidence", np.degrees(maps.incidence_rad.astype(np.float64)), "deg", "Angle of incidence", "magma"),
    )
    for name, values, unit, title, colours in floats:
        write_map_png16(named(f"{name}_16bit.png"), values, name, unit, force=force)
        write_png(named(f"{name}.png"), coloured_map(values, title, unit, subtitle=subtitle, colours=colours), force=force)
    if len(maps.part_names) <= 65535:
        write_id_png16(named("part_id_16bit.png"), maps.part_id, maps.part_names, force=force)
        picture = coloured_ids(maps.part_id, maps.part_names, "Surface seen first", subtitle=subtitle)
        write_png(named("part_id.png"), picture, force=force)
    write_png(named("contours.png"), contour_picture(maps.depth_mm, title="Contours of depth"), force=force)
    return written
