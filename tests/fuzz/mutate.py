"""Inputs for the readers, and what chance does to them: flipped bits, cuts, repeats, foreign bytes and numbers that lie."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from rangecheck.optics import PinholeCamera, RayGrid
from rangecheck.scan import RangeScan
from rangecheck.scan.readers import write_npz, write_pcd, write_ptx, write_scans

CAMERA = PinholeCamera(14, 11, 20.0, 21.0, 6.5, 5.5)
#: numbers that readers stumble over, as text and as bytes
LIES = [
    b"-1",
    b"0",
    b"1e999",
    b"nan",
    b"4294967295",
    b"9223372036854775808",
    b"99999999999999999999999",
    b"1.5",
    b"''",
    b"\xff\xfe",
    b"65537",
    b"0x10",
]


def corpus(folder: Path) -> dict[str, bytes]:
    """One small good file per format, by name; depth pictures come with their JSON as `name|json`."""
    random = np.random.default_rng(0)
    ranges = random.uniform(400, 410, (11, 14)).astype(np.float32)
    ranges[random.random(ranges.shape) < 0.2] = np.nan
    scan = RangeScan(ranges, CAMERA, brightness=random.random(ranges.shape), name="a")
    origins, directions = CAMERA.pixel_rays()
    own = RangeScan(ranges, RayGrid(14, 11, np.array(origins), np.array(directions)), name="b")
    write_scans(folder / "m", [scan], step_mm=0.02)
    write_npz(folder / "a.npz", own)
    for kind in ("ascii", "binary", "binary_compressed"):
        write_pcd(folder / f"{kind}.pcd", scan, kind=kind)
    write_ptx(folder / "a.ptx", scan)
    files = {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()}
    entry = json.loads((folder / "m" / "scans.json").read_text())["scans"][0]
    lone = {"unit": "mm", "measures": "depth", "step": 0.02, "camera": entry["camera"]}
    files["a.png"] = (folder / "m" / "a.png").read_bytes()
    depth = np.nan_to_num(scan.depth_mm)
    files["a.pfm"] = b"Pf\n14 11\n-1.0\n" + depth[::-1].astype("<f4").tobytes()
    from PIL import Image

    for name, compression in (("raw", "raw"), ("lzw", "tiff_lzw"), ("deflate", "tiff_deflate")):
        Image.fromarray(depth).save(folder / "x.tif", compression=compression)
        files[f"{name}.tif"] = (folder / "x.tif").read_bytes()
    try:
        import OpenEXR
    except ImportError:
        pass
    else:
        for name, how in (("zip", OpenEXR.ZIP_COMPRESSION), ("none", OpenEXR.NO_COMPRESSION), ("zips", OpenEXR.ZIPS_COMPRESSION)):
            OpenEXR.File({"compression": how, "type": OpenEXR.scanlineimage}, {"Z": depth}).write(str(folder / "x.exr"))
            files[f"{name}.exr"] = (folder / "x.exr").read_bytes()
    files["m.json"] = json.dumps(
        {"schema": "rangecheck/scans/1", "unit": "mm", "scans": [entry | {"image": "good.png", "brightness": None}]}
    ).encode()
    files["good.png"] = files["a.png"]
    files["lone.json"] = json.dumps(lone | {"image": "good.png"}).encode()
    points = np.round(scan.points_mm(), 3)
    files["a.xyz"] = "\n".join(" ".join(map(str, p)) for p in points.tolist()).encode()
    index = np.where(scan.valid, np.cumsum(scan.valid).reshape(ranges.shape) - 1, -1).ravel()
    head = (
        "ply\nformat {} 1.0\nobj_info num_cols 14\nobj_info num_rows 11\nelement vertex {}\n"
        + "property float x\nproperty float y\n"
    )
    head += "property float z\nelement range_grid 154\nproperty list uchar int vertex_indices\nend_header\n"
    body = "".join(f"{x} {y} {z}\n" for x, y, z in points.tolist()) + "".join("0\n" if i < 0 else f"1 {i}\n" for i in index)
    files["ascii.ply"] = (head.format("ascii", len(points)) + body).encode()
    raw = points.astype("<f4").tobytes() + b"".join(b"\0" if i < 0 else b"\1" + np.int32(i).tobytes() for i in index)
    files["binary.ply"] = head.format("binary_little_endian", len(points)).encode() + raw
    files["good.ply"] = files["ascii.ply"]
    files["a.conf"] = b"camera 0 0 0 0 0 0 1\nbmesh good.ply 0.1 0 0 0 0 0 1\n"
    cyber = "Cyberware Digitizer Data\nSPACE=CYLINDRICAL\nNLG=20\nLGINCR=12272\nNLT=9\nLTINCR=700\nRSHIFT=3\nDATA=\n"
    files["a.cyb"] = cyber.encode() + np.full(180, 9000, ">i2").tobytes()
    files |= _e57_and_range_map(scan)
    return files


def _e57_and_range_map(scan: RangeScan) -> dict[str, bytes]:
    from test_readers_e57 import grid_e57
    from test_readers_maps import range_map

    return {"a.e57": grid_e57(), "map.ply": range_map(scan)}


def companion(name: str) -> bytes | None:
    """The JSON that belongs beside a depth picture."""
    if not name.endswith((".png", ".tif", ".exr", ".pfm")):
        return None
    entry = {"unit": "mm", "measures": "depth", "camera": CAMERA.to_dict()}
    return json.dumps(entry | ({"step": 0.02} if name.endswith(".png") else {})).encode()


def mutated(content: bytes, random: np.random.Generator, others: list[bytes]) -> bytes:
    """`content` after one to four accidents."""
    for _ in range(int(random.integers(1, 5))):
        size = len(content)
        if size == 0:
            return content
        kind, at = int(random.integers(9)), int(random.integers(size))
        if kind == 0:
            content = content[:at] + bytes([content[at] ^ (1 << int(random.integers(8)))]) + content[at + 1 :]
        elif kind == 1:
            content = content[:at] + random.bytes(int(random.integers(1, 9))) + content[at + int(random.integers(9)) :]
        elif kind == 2:
            content = content[:at]
        elif kind == 3:
            end = min(size, at + int(random.integers(1, 200)))
            content = content[:end] + content[at:end] * int(random.integers(1, 4)) + content[end:]
        elif kind == 4:
            content = content[:at] + content[at + int(random.integers(1, 200)) :]
        elif kind == 5:
            other = others[int(random.integers(len(others)))]
            start = int(random.integers(max(len(other), 1)))
            content = content[:at] + other[start : start + int(random.integers(1, 100))] + content[at:]
        elif kind in (6, 7):
            numbers = list(re.finditer(rb"-?\d+(\.\d+)?", content[:4000]))
            if numbers:
                hit = numbers[int(random.integers(len(numbers)))]
                content = content[: hit.start()] + LIES[int(random.integers(len(LIES)))] + content[hit.end() :]
        else:
            extreme = [b"\xff" * 4, b"\0" * 4, b"\x7f\xff\xff\xff", b"\x80\0\0\0", b"\0\0\xc0\x7f"][int(random.integers(5))]
            content = content[:at] + extreme + content[at + 4 :]
    return content
