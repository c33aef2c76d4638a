"""Does a picture agree with its truth, and the truth with itself? Empty: it does."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from rangecheck.dataset.index import mask_of
from rangecheck.optics import camera_from_dict
from rangecheck.rigid import inverse, move_points
from rangecheck.surface import Surface

#: points sent back by their distance lie on their facets within this share of the object's extent
BOUND = 1e-6
#: how many standard deviations a pixel of the picture may lie from what its radiance says, where millions of pixels are looked at
SIGMAS = 7.0


def check_picture(row: dict[str, Any], picture: Any, truth: bytes, surface: Surface) -> list[str]:
    """What is wrong with picture (h, w[, 3]) uint8, its row of the index and its NPZ, said in sentences."""
    wrong: list[str] = []
    camera, pose = camera_from_dict(row["camera"]), np.array(row["world_from_camera"])
    shape = (row["height"], row["width"])
    with np.load(io.BytesIO(truth), allow_pickle=False) as file:
        maps = {name: file[name] for name in file.files}
    for name, array in maps.items():
        found = array.shape[1:] if name == "shadows" else array.shape[:2]
        if found != shape:
            wrong.append(f"{name} has shape {array.shape}; the picture is {shape}")
    if picture.shape[:2] != shape:
        wrong.append(f"the picture has shape {picture.shape}; its row says {shape}")
    if wrong:
        return wrong
    hit = maps["face"] >= 0
    for name, seen in (
        ("distance_mm", np.isfinite(maps["distance_mm"])),
        ("depth_mm", np.isfinite(maps["depth_mm"])),
        ("incidence_rad", np.isfinite(maps["incidence_rad"])),
        ("part_id", maps["part_id"] > 0),
    ):
        if (seen != hit).any():
            wrong.append(f"{name} sees something in {int(seen.sum())} pixels, the faces in {int(hit.sum())}")
    if (maps["secondary_id"][~hit] != 0).any() or (maps["shadows"][:, ~hit] != 0).any():
        wrong.append("secondary IDs or shadows stand where nothing is seen")
    origins, directions = camera.pixel_rays()
    points = move_points(pose, origins + maps["distance_mm"][..., None] * directions)[hit]
    face = maps["face"][hit]
    corner, normal = surface.triangles[face, 0], surface.face_normals[face]
    off = np.abs(((points - corner) * normal).sum(axis=1)).max(initial=0.0)
    if off > BOUND * surface.extent_mm:
        wrong.append(f"points sent back lie up to {off:.3g} mm off their facets")
    depth = move_points(inverse(pose), points)[:, 2]
    if np.abs(depth - maps["depth_mm"][hit]).max(initial=0.0) > BOUND * surface.extent_mm:
        wrong.append("depth is not the distance's component along the axis")
    if (surface.part_of_face[face] + 1 != maps["part_id"][hit]).any():
        wrong.append("part IDs are not those of the faces")
    wrong += _masks(row, maps["part_id"])
    return wrong + _light(row, picture, maps, hit)


def _masks(row: dict[str, Any], part_id: Any) -> list[str]:
    wrong = []
    drawn = np.zeros(part_id.shape, np.int64)
    for region in row["regions"]:
        mask = mask_of(region["runs"], row["height"], row["width"])
        if int(mask.sum()) != region["area"]:
            wrong.append(f"the mask of {region['name']} has {int(mask.sum())} pixels, its area says {region['area']}")
        drawn[mask] = region["part"]
    if (drawn != part_id).any():
        wrong.append("the masks are not the part IDs")
    return wrong


def _light(row: dict[str, Any], picture: Any, maps: dict[str, Any], hit: Any) -> list[str]:
    """The picture is the radiance, but for its noise; what is seen wholly is lit or dark as the maps say."""
    wrong = []
    sensor, full = row["sensor"], 2 ** row["sensor"]["bits"] - 1
    level = np.minimum(maps["radiance"].astype(np.float64) * row["exposure"], 1.0)
    noise = np.sqrt(level / sensor["full_well"] + (sensor["read_noise"] / sensor["full_well"]) ** 2)
    away = np.abs(picture / full - level) - 0.5 / full
    # a pixel's electrons are counted: Poisson's tail is longer than Gauss's where few are expected
    allowed = SIGMAS * noise + SIGMAS**2 / sensor["full_well"]
    if (away > allowed).any():
        wrong.append(f"{int((away > allowed).sum())} pixels lie further from their radiance than the sensor's noise allows")
    seen = maps["coverage"]
    if (hit & (seen == 0)).any() or (~hit & (seen == 1)).any():
        both = int((hit & (seen == 0)).sum() + (~hit & (seen == 1)).sum())
        # a facet narrower than a pixel may be met by the middle ray alone, or missed by it alone
        edge = _edges(hit)
        if ((hit & (seen == 0)) & ~edge).any() or ((~hit & (seen == 1)) & ~edge).any():
            wrong.append(f"{both} pixels are seen in the picture and not in the maps, or the other way round")
    return wrong


def _edges(hit: Any) -> Any:
    """Pixels beside the border between what is seen and what is not."""
    padded = np.pad(hit, 1, mode="edge")
    stack = np.stack([padded[r : r + hit.shape[0], c : c + hit.shape[1]] for r in range(3) for c in range(3)])
    return stack.any(axis=0) != stack.all(axis=0)
